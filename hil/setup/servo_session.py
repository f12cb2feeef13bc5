"""A session with the arm's servos: their settings are saved before the first write and restored after the last.

A session holds the port. A session inside another one for the same arm shares it, so that the steps of a pilot write
each EEPROM register only once, and restore it once, when the outermost block is left for whatever reason. If a killed
program left saved settings behind, these count as the servos' own and are restored at the end.
"""

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from hil import fakes
from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, TorqueNotOff
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import attainable, put_back, read_settings
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode
from hil.drivers.torque_off import and_list, by_reason, signals_held_back
from hil.errors import ExperimentError, RunFolderError, StopRequested
from hil.setup import settings_file
from hil.setup.changed_settings import Settings, settings_now
from hil.setup.current_limit import current_limit_ticks
from hil.setup.others import others_on_the_bus
from hil.setup.settings_file import Kept
from hil.setup.unmoved import Lies, where_it_lies

__all__ = [
    "SETTINGS_NAME",
    "Say",
    "ServoSession",
    "has_moved",
    "lay_at_start",
    "left_behind",
    "recover",
    "servo_session",
    "settings_at_start",
    "to_stderr",
]

Say = Callable[[str], None]

_DELAY = "Return Delay Time"
_PWM_LIMIT = "PWM Limit"

SETTINGS_NAME = "servo_settings.json"
"""Name of the copy of the saved settings in the run folder."""


REBOOT_S = 0.6
"""Time before a servo that does not answer at the end, and may be booting, is tried again [s]."""


_LATE_CONFIRMED = "Replies were missing when torque was cut at the end of the run: check the cables and the supply."
"""Said if every servo has answered in the end, and nothing else is wrong."""

COUNT_DOWN_S = 5.0
"""Time between the warning that an arm will move again after a stopped run and switching torque on [s].
"""


def to_stderr(text: str) -> None:
    """Print a message on standard error; standard output may be reserved for results."""
    with suppress(OSError, ValueError):
        print(f"hil: {text}", file=sys.stderr)


@dataclass
class ServoSession:
    """An open bus and the saved settings of its servos; created by `servo_session`."""

    bus: ServoBus
    _say: Say
    _kept: dict[Joint, Kept] = field(default_factory=dict)
    _delays: dict[Joint, int] = field(default_factory=dict)
    """Return Delay Time of each servo at the beginning [2 us]."""
    settings: Settings = field(default_factory=dict)
    """What `settings_now` found at the beginning."""
    lay: Lies = field(default_factory=dict)
    """Where the servos were at the beginning."""
    _left: set[Joint] = field(default_factory=set)
    """Servos whose settings an earlier run left changed; restoring a goal that a lowered limit cuts is retried only
    once.
    """
    _cut: dict[Joint, dict[str, int]] = field(default_factory=dict)
    """Goals that could only be restored as far as a lowered limit allows, with their values."""
    shared: int = 0
    """Number of inner blocks that have used the bus."""
    was_stopped: bool = False
    """Whether the last inner block ended with an exception: the arm went limp earlier than planned."""

    def begin(self, config: Config, folder: Path | None) -> None:
        """Check that the servos answer and that nobody holds the arm, then save their settings.

        Nothing is written to a servo before its settings are on disk. Same errors as `ServoBus.open`.
        """
        bus = self.bus
        bus.check_identity()
        left = {joint: kept for joint in bus.drives if (kept := left_behind(bus.port.url, joint)) is not None}
        bus.release_held(ours=left)
        self.lay = where_it_lies(bus)
        if others := others_on_the_bus(bus):
            self._say(f"Also on this bus (left alone): {'; '.join(others)}.")
        described = {
            drive: each for joint, each in zip(bus.joints, config.joints, strict=True) for drive in joint.drives
        }
        for joint, servo in bus.drives.items():
            settings = read_settings(servo)
            self._delays[joint] = servo.read(_DELAY)
            if joint in left:
                self._left.add(joint)
                settings = _before(left[joint], settings)
                self._say(
                    f"{joint.title}: an earlier run ended before it could restore its settings "
                    f"({left[joint].since}); this one will."
                )
            changed = {"Operating Mode": int(joint.mode)}
            if joint.mode is Mode.CURRENT:
                share = described[joint].goal_limit / len(described[joint].ids)
                changed["Current Limit"] = current_limit_ticks(joint, share)
            self._keep(joint, settings, changed)
        self.settings = settings_now(bus)
        if folder is not None:
            copies = {str(joint.id): kept.settings for joint, kept in self._kept.items()}
            settings_file.write_durably(folder / SETTINGS_NAME, {"port": bus.port.url, "servos": copies})

    def _keep(self, joint: Joint, settings: dict[str, int], changed: dict[str, int]) -> None:
        url, model = self.bus.port.url, joint.servo.name
        try:
            self._kept[joint] = settings_file.keep(url, joint.id, model, settings, changed)
        except RunFolderError as error:
            self._say(
                f"The settings of {joint} cannot be saved ({error}). If this program is killed, its Operating Mode "
                f"{settings['Operating Mode']} and Current Limit must be restored by hand."
            )
            self._kept[joint] = Kept(url, joint.id, model, settings, changed, 0, "")

    def warn(self) -> None:
        """If the last run was stopped, announce that the arm is about to move again, and give people time to step back.

        Anyone who saw it go limp may believe that the program has ended, and reach into the arm.
        """
        if not self.was_stopped:
            return
        self.was_stopped = False
        self._say(
            f"THE ARM MOVES AGAIN IN {COUNT_DOWN_S:.0f} s: the previous run was stopped, but this command continues. "
            f"Keep clear of the arm; Ctrl-C ends it now."
        )
        clock = self.bus.port.clock
        clock.wait_until(clock.now() + COUNT_DOWN_S)

    def end(self) -> list[str]:
        """Restore every servo's settings; return a message for each reason why some cannot be.

        Never raises DriverError.
        """
        failed = self._put_back(self._kept)
        if failed:
            clock = self.bus.port.clock
            clock.wait_until(clock.now() + REBOOT_S)
            failed = self._put_back(failed)
        return [
            *self._changed_delays(failed),
            *self._lowered_limits(failed),
            *(
                f"The settings of {and_list(map(str, joints))} could not be restored. {why} The next hil identify, "
                f"record, check or setup on this port restores them from {self._where(joints)}."
                for why, joints in by_reason((joint, str(error)) for joint, error in failed.items()).items()
            ),
        ]

    def _changed_delays(self, silent: Collection[Joint]) -> Iterator[str]:
        """Say which Return Delay Times were changed meanwhile, by another program or a factory reset."""
        for joint, before in self._delays.items():
            now = before
            if joint not in silent:
                with suppress(DriverError):
                    now = self.bus.drives[joint].read(_DELAY)
            if now != before:
                yield (
                    f"{joint.title}: {_DELAY} was changed meanwhile from {2 * before} to {2 * now} us, by another "
                    "program or a factory reset, which changes other settings too. To set it: "
                    f"hil setup {self.bus.port.url} --id {joint.id} --return-delay-us {2 * before}"
                )

    def _lowered_limits(self, silent: Collection[Joint]) -> Iterator[str]:
        """Say which PWM Limits were lowered meanwhile, and which goals they keep from being restored."""
        for joint, servo in self.bus.drives.items():
            before = self.settings.get((joint, _PWM_LIMIT))
            if before is None or joint in silent:
                continue
            with suppress(DriverError):
                now, wanted = servo.read(_PWM_LIMIT), self._kept[joint].settings
                if now == before:
                    continue
                cut = [f"{name} is {value}, not {wanted[name]}" for name, value in self._cut[joint].items()]
                later = (
                    "; the next start on this port then restores the goal" if cut and joint not in self._left else ""
                )
                yield (
                    f"{joint.title}: {_PWM_LIMIT} was changed meanwhile from {before} to {now}, by another program "
                    f"or a factory reset, and is left as it is{': ' if cut else ''}{', '.join(cut)}. "
                    f"To change it back, use DYNAMIXEL Wizard 2.0{later}."
                )

    def _where(self, joints: Sequence[Joint]) -> str:
        """The file that holds the settings of a servo; for several servos, their folder."""
        paths = [self._kept[joint].path for joint in joints]
        return str(paths[0]) if len(paths) == 1 else f"{len(paths)} files in {paths[0].parent}"

    def _put_back(self, joints: Iterable[Joint]) -> dict[Joint, DriverError]:
        """Restore the settings of these joints; return the error of each joint that failed."""
        failed: dict[Joint, DriverError] = {}
        for joint in joints:
            try:
                self.bus.confirm_later(joint)
                servo, settings = self.bus.drives[joint], self._kept[joint].settings
                put_back(servo, settings)
                possible = attainable(servo, settings)
                self._cut[joint] = {name: value for name, value in possible.items() if value != settings[name]}
            except DriverError as error:
                failed[joint] = error
            else:
                if not self._cut[joint] or joint in self._left:
                    settings_file.forget(self._kept[joint])
        return failed


_outermost: ContextVar[ServoSession | None] = ContextVar("_outermost", default=None)


@contextmanager
def servo_session(config: Config, folder: Path | None = None, say: Say = to_stderr) -> Iterator[ServoBus]:
    """Open the bus with every servo in its mode and torque off, prepared for exchanges; restore settings at the end.

    Raises ExperimentError at the end if a setting is not as it was and nothing else has ended the block.

    A TorqueNotOff that leaves the block reports the final state: servos that answer again are read back. If all have,
    what ended the block before is raised in its place.

    folder: run folder that receives a copy of the settings. say: receives messages for the user. Same
    errors as `ServoBus.open`, and RunFolderError.
    """
    outer = _outermost.get()
    if outer is not None and outer.bus.port.is_open and outer.bus.config.is_same_arm(config.bus):
        outer.bus.config = config.bus
        outer.shared += 1
        outer.warn()
        outer.bus.prepare()
        try:
            yield outer.bus
        except BaseException:
            outer.was_stopped = True
            raise
        return
    fakes.register_for(config.url)
    with ServoBus.connect(config.bus) as bus, _telling_of_torque(bus):
        session = ServoSession(bus, say)
        token = _outermost.set(session)
        stopped: BaseException | None = None
        try:
            session.begin(config, folder)
            bus.prepare()
            yield bus
        except BaseException as error:
            stopped = error
            raise
        finally:
            _outermost.reset(token)
            with signals_held_back():
                left = session.end()
            instead = confirmed_later(bus, stopped) if isinstance(stopped, TorqueNotOff) else None
            if ended := instead or stopped:
                for line in left:  # after what stopped the arm and the state of its torque, which matter more
                    ended.add_note(line)
            elif left:
                raise ExperimentError(" ".join(left))
            if instead is not None:
                raise instead from None


def confirmed_later(bus: ServoBus, error: TorqueNotOff) -> BaseException | None:
    """What to raise in place of `error` if torque is off on all servos by now; None if it is not.

    That is what cut torque, with a note about torque, or an ExperimentError if nothing but the silence of servos did.
    """
    report = bus.torque_off_report
    error.args = (str(report),)
    if report is None or report.unconfirmed:
        return None
    cause = error.__context__
    if cause is None:
        return ExperimentError(f"{_LATE_CONFIRMED} {report}")
    cause.add_note(str(report))
    return cause


@contextmanager
def _telling_of_torque(bus: ServoBus) -> Iterator[None]:
    """Add a note about torque to any exception that ends the block, unless it has one: a stop may come between two
    runs.
    """
    try:
        yield
    except TorqueNotOff:
        raise
    except BaseException as ended:
        is_stop = isinstance(ended, KeyboardInterrupt | StopRequested)
        told = any("torque" in note.lower() for note in getattr(ended, "__notes__", []))
        if not told and (is_stop or bus.torque_off_report is not None):
            with signals_held_back():
                ended.add_note(_about_torque(bus))
        raise


def _about_torque(bus: ServoBus) -> str:
    """A sentence about the servos' torque while no run is in progress."""
    if bus.torque_off_report is not None:
        return str(bus.torque_off_report)
    try:
        on = [joint.title for joint, servo in bus.drives.items() if servo.read("Torque Enable")]
    except DriverError as error:
        return f"This command has not switched torque on; whether it is off could not be read: {error}"
    if on:
        return f"TORQUE IS ON at {' and '.join(on)}: it was on before this command."
    return "Torque is off on all servos, read back; this command has not switched it on."


def has_moved() -> bool:
    """Whether an earlier run of this session may have left the arm away from its rest pose, held by friction."""
    outer = _outermost.get()
    return outer is not None and outer.shared > 1


def settings_at_start() -> Settings:
    """The servos' settings at the beginning of this session (`changed_settings.settings_now`)."""
    outer = _outermost.get()
    return {} if outer is None else outer.settings


def lay_at_start() -> Lies:
    """Where the servos were at the beginning of this session; empty if a run may have moved the arm since."""
    outer = _outermost.get()
    return {} if outer is None or outer.shared > 1 else outer.lay


def left_behind(port: str, joint: Joint) -> Kept | None:
    """Settings of this joint's servo that a terminated program left unrestored; None if there are none."""
    kept = settings_file.load(port, joint.id, joint.servo.name)
    return kept if kept is not None and kept.may_restore else None


def recover(servo: Servo, port: str) -> list[str]:
    """Restore settings that a terminated program left changed; return those written. Same errors as `Servo.write`."""
    kept = settings_file.load(port, servo.id, servo.table.model)
    if kept is None or not kept.may_restore:
        return []
    if servo.read("Torque Enable"):
        servo.write("Torque Enable", 0)
    written = put_back(servo, _before(kept, read_settings(servo)))
    settings_file.forget(kept)
    return [f"{name} {before} -> {after}" for name, (before, after) in written.items()]


def _before(kept: Kept, present: dict[str, int]) -> dict[str, int]:
    """The settings before the program that was killed, except for registers that have been changed since.

    A register that holds neither the value set by that program nor the one it found was changed by something else. If
    that is the Operating Mode, goals and gains belong to the new mode and are kept.
    """
    theirs = {name for name, value in kept.changed.items() if present.get(name) not in (value, kept.settings.get(name))}
    wanted = present if "Operating Mode" in theirs else kept.settings
    untouched = {name: kept.settings[name] for name in kept.changed if name in kept.settings and name not in theirs}
    return {**wanted, **untouched, **{name: present[name] for name in theirs if name in present}}
