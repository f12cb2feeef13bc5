"""A session with the arm's servos: their settings are saved before the first write and restored after the last.

A session holds the port. A session inside another one for the same arm shares the port, so that the steps of a pilot
write each EEPROM register only once. Each register is also restored only once, when the outermost block is left for
whatever reason. If a killed program left saved settings behind, these are taken as the servos' original settings and
restored at the end (`killed_run`).
"""

import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from hil import fakes
from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, TorqueNotOff, WrongModel, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import attainable, holds, put_back, read_settings
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode
from hil.drivers.torque.off import and_list, by_reason, signals_held_back
from hil.errors import ExperimentError, RunFolderError, StopRequested
from hil.setup import settings_file
from hil.setup.changed_settings import Settings, settings_now
from hil.setup.current_limit import current_limit_ticks
from hil.setup.killed_run import Left, left_behind, recover, what_is_left
from hil.setup.others import others_on_the_bus
from hil.setup.settings_file import Kept
from hil.setup.unmoved import Lies, where_it_lies

__all__ = [
    "SETTINGS_NAME",
    "Say",
    "ServoSession",
    "has_moved",
    "lay_at_start",
    "servo_session",
    "settings_at_start",
    "to_stderr",
]

Say = Callable[[str], None]

_DELAY = "Return Delay Time"
_OFFSET, _DRIVE_MODE = "Homing Offset", "Drive Mode"
_PWM_LIMIT, _GOAL_PWM = "PWM Limit", "Goal PWM"
_NEXT = "The next hil identify, record, check or setup on this port restores them from"

SETTINGS_NAME = "servo_settings.json"
"""Name of the copy of the saved settings in the run folder."""


_MOST_CHECKS = 3
"""How often the settings of all servos are read again once they have been restored."""

_UNVERIFIED = "its registers were written but read differently afterwards: they are unverified."

_MOST_CUTS = 5
"""Largest number of times that torque is cut again at the end if another program switches it on."""

REBOOT_S = 0.6
"""A servo that does not answer at the end may be booting; it is tried again after this time [s]."""


_LATE_CONFIRMED = "Replies were missing when torque was cut at the end of the run: check the cables and the supply."
"""Message if every servo has answered in the end and nothing else is wrong."""

_TELLS_OF_TORQUE = re.compile("torque (off )?is", re.IGNORECASE)
"""Matches every sentence that says whether torque is off (see `TorqueOff`)."""

COUNT_DOWN_S = 5.0
"""After a stopped run: time from the warning that the arm will move again until torque is switched on [s].
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
    """The servos' settings at the beginning, as read by `settings_now`."""
    lay: Lies = field(default_factory=dict)
    """Positions of the servos at the beginning."""
    _wanted: dict[Joint, dict[str, int]] = field(default_factory=dict)
    """Settings to restore: the saved ones, except for registers that another program has changed since a run was
    killed.
    """
    _left: dict[Joint, Kept] = field(default_factory=dict)
    """Saved settings of the servos that an earlier run did not restore."""
    _refused: set[Joint] = field(default_factory=set)
    """Servos whose Current Limit another program has left too low for this run; the file keeps its former value."""
    _is_ours: bool = False
    """Whether the servos are the arm's and no other program holds them, so that they may be written to."""
    _cut: dict[Joint, dict[str, int]] = field(default_factory=dict)
    """Goals that could only be restored as far as a lowered limit allows, with the restored values."""
    _on_again: dict[Joint, int] = field(default_factory=dict)
    """Servos whose torque another program has switched on since it was cut, and the number of times it was cut again.
    """
    _torque: dict[Joint, bool | None] = field(default_factory=dict)
    """Whether each servo's torque was on at the latest reading; None if unknown (`ServoBus.torque_now`)."""
    shared: int = 0
    """Number of inner sessions that have used the bus."""
    was_stopped: bool = False
    """Whether the last inner session ended with an exception: the arm went limp earlier than planned."""

    def begin(self, config: Config, folder: Path | None) -> None:
        """Check that the servos answer and that no other program holds the arm, then save their settings.

        Nothing is written to a servo before its settings are on disk. Raises the same errors as `ServoBus.open`.
        """
        bus = self.bus
        self._left = {joint: kept for joint in bus.drives if (kept := left_behind(bus.port.url, joint)) is not None}
        bus.check_identity()
        bus.release_held(ours=self._left)
        self._is_ours = True
        self.lay = where_it_lies(bus)
        if others := others_on_the_bus(bus):
            self._say(f"Also on this bus (left alone): {'; '.join(others)}.")
        described = {
            drive: each for joint, each in zip(bus.joints, config.joints, strict=True) for drive in joint.drives
        }
        for joint, servo in bus.drives.items():
            settings = read_settings(servo)
            self._delays[joint] = servo.read(_DELAY)
            changed = {"Operating Mode": int(joint.mode)}
            if joint.mode is Mode.CURRENT:
                share = described[joint].goal_limit / len(described[joint].ids)
                changed["Current Limit"] = current_limit_ticks(joint, share)
            if joint in self._left:
                self._take_over(joint, what_is_left(self._left[joint], servo, settings), changed)
            else:
                self._keep(joint, settings, changed)
        self.settings = settings_now(bus)
        if folder is not None:
            copies = {str(joint.id): kept.settings for joint, kept in self._kept.items()}
            settings_file.write_durably(folder / SETTINGS_NAME, {"port": bus.port.url, "servos": copies})

    def _take_over(self, joint: Joint, left: Left, changed: dict[str, int]) -> None:
        """Save what an earlier run left, and say what of it will be restored.

        What another program has changed is the servo's own value from now on, unless it prevents this run.
        """
        if said := left.told(joint.title):
            self._say(said)
        if left.is_refused(changed):
            self._refused.add(joint)
            self._keep(joint, left.kept.settings, changed, left.kept.since)
            self._wanted[joint] = left.wanted
        else:
            self._keep(joint, left.wanted, changed)

    def _keep(self, joint: Joint, settings: dict[str, int], changed: dict[str, int], since: str = "") -> None:
        url, model = self.bus.port.url, joint.servo.name
        self._wanted[joint] = settings
        try:
            self._kept[joint] = settings_file.keep(url, joint.id, model, settings, changed, since)
        except RunFolderError as error:
            self._say(
                f"The settings of {joint} cannot be saved ({error}). If this program is killed, the servo's Operating "
                f"Mode {settings['Operating Mode']} and Current Limit must be restored by hand."
            )
            self._kept[joint] = Kept(url, joint.id, model, settings, changed, 0, "")

    def warn(self) -> None:
        """If the last run was stopped, announce that the arm is about to move again, and give people time to step back.

        Anyone who saw it go limp may believe that the program has ended, and reach into the arm's workspace.
        """
        if not self.was_stopped:
            return
        self.was_stopped = False
        self._say(
            f"THE ARM MOVES AGAIN IN {COUNT_DOWN_S:.0f} s: the previous run was stopped, but this command continues. "
            f"Keep clear of the arm; Ctrl-C ends this command now."
        )
        self.bus.wait_switched_off(self.bus.port.clock.now() + COUNT_DOWN_S)

    def end(self) -> list[str]:
        """Restore every servo's settings; return one message per reason for which some could not be restored.

        Torque is read last of all, and cut again where another program has switched it on meanwhile; the settings are
        restored again after that. Never raises DriverError.
        """
        failed = self._put_back(self._kept)
        while failed and self._cut_again(failed):
            pass
        if failed:
            clock = self.bus.port.clock
            clock.wait_until(clock.now() + REBOOT_S)
            failed = self._put_back(failed)
        self._verify(failed)
        left = self._what_is_left(failed)
        while self._cut_again(failed):
            self._verify(failed)
            left = self._what_is_left(failed)
        self._forget(joint for joint in self._kept if joint not in failed)
        return [*self._switched_on_by_another(), *left]

    def _verify(self, failed: dict[Joint, DriverError]) -> None:
        """Read the settings of all servos again once the last one has been restored, and restore those that differ.

        Replies that belong to earlier requests, or IDs that are swapped meanwhile, make a servo seem restored that was
        never reached. failed: receives the errors of the servos whose settings still differ.
        """
        for attempt in range(_MOST_CHECKS):
            unlike = {
                joint: error
                for joint in self._kept
                if joint not in failed and (error := self._differs(joint)) is not None
            }
            if not unlike:
                return
            failed |= self._put_back(unlike) if attempt < _MOST_CHECKS - 1 else unlike

    def _differs(self, joint: Joint) -> DriverError | None:
        """The error for a servo whose settings are not read as restored, or cannot be read; None if they are."""
        try:
            is_held = holds(self.bus.drives[joint], self._wanted[joint])
        except DriverError as error:
            return error
        return None if is_held else WrongSetting(f"{joint.title}: {_UNVERIFIED}")

    def _cut_again(self, failed: dict[Joint, DriverError]) -> bool:
        """Cut torque where it is on and restore these servos' settings; return whether there was anything to do.

        failed: receives the errors of the servos whose settings could not be restored.
        """
        if not self._is_ours:
            return False
        self._torque = self.bus.torque_now()
        on = [joint for joint, is_on in self._torque.items() if is_on]
        if not on or max(self._on_again.get(joint, 0) for joint in on) >= _MOST_CUTS:
            return False
        self.bus.cut_foreign_torque(on)
        for joint in on:
            self._on_again[joint] = self._on_again.get(joint, 0) + 1
            failed.pop(joint, None)
        failed |= self._put_back(joint for joint in on if joint in self._kept)
        return True

    def _switched_on_by_another(self) -> Iterator[str]:
        """Say at which servos another program switched torque on after it had been cut, unless it still is on."""
        on = [joint for joint, is_on in self._torque.items() if is_on]
        silent = [joint for joint in self._on_again if self._torque.get(joint, True) is None]
        if on or silent:
            self.bus.report_driven(on, silent)
        if off := [joint for joint in self._on_again if joint not in {*on, *silent}]:
            yield (
                f"Another program switched torque on at {and_list(map(str, off))} while the settings were being "
                "restored. It was cut again and was still off when it was last read. End that program before "
                "you reach into the arm: it may switch torque on again."
            )

    def _what_is_left(self, failed: Mapping[Joint, DriverError]) -> list[str]:
        """A message for each reason why a setting is not as it was.

        failed: the errors of the servos whose settings could not be restored.
        """
        return [
            *self._not_reached(),
            *self._changed_delays(failed),
            *self._lowered_limits(failed),
            *self._changed_meaning(failed),
            *(
                f"The settings of {and_list(map(str, joints))} could not be restored. {why} {_NEXT} "
                f"{_where([self._kept[joint].path for joint in joints])}."
                for why, joints in by_reason((joint, str(error)) for joint, error in failed.items()).items()
            ),
        ]

    def _not_reached(self) -> Iterator[str]:
        """Restore what an earlier run left on servos that this one did not get to; say where that is impossible."""
        waiting: list[tuple[Joint, str]] = []
        for joint, kept in self._left.items():
            if joint in self._kept:
                continue
            why = "This run ended before it could restore them."
            if self._is_ours:
                try:
                    self.bus.confirm_later(joint)
                    if (others := recover(self.bus.drives[joint], kept.port).others) != "":
                        yield f"{joint.title}: {others}"
                    continue
                except DriverError as error:
                    why = str(error)
            waiting.append((joint, why))
        for why, joints in by_reason(waiting).items():
            paths = [self._left[joint].path for joint in joints]
            yield (
                f"The settings that an earlier run left on {and_list(map(str, joints))} are not restored yet. {why} "
                f"{_NEXT} {_where(paths)}."
            )

    def _changed_delays(self, silent: Collection[Joint]) -> Iterator[str]:
        """Say which Return Delay Times were changed meanwhile, by another program or a factory reset."""
        for joint, before in self._delays.items():
            now = before
            if joint not in silent:
                with suppress(DriverError):
                    now = self.bus.drives[joint].read(_DELAY)
            if now != before:
                yield (
                    f"{joint.title}: {_DELAY} was changed during this command from {2 * before} to {2 * now} us, by "
                    "another program or a factory reset, which changes other settings too. To restore it: "
                    f"hil setup {self.bus.port.url} --id {joint.id} --return-delay-us {2 * before}"
                )

    def _lowered_limits(self, silent: Collection[Joint]) -> Iterator[str]:
        """Say which PWM Limits were lowered meanwhile, and which goals they keep from being restored."""
        for joint, servo in self.bus.drives.items():
            before = self.settings.get((joint, _PWM_LIMIT))
            if before is None or joint in silent:
                continue
            with suppress(DriverError):
                now, wanted = servo.read(_PWM_LIMIT), self._wanted[joint]
                if now == before:
                    continue
                cut = [
                    f"{name} is {value}, not {wanted[name]}"
                    for name, value in self._cut[joint].items()
                    if name == _GOAL_PWM
                ]
                later = (
                    "; the next start on this port then restores the goal" if cut and joint not in self._left else ""
                )
                yield (
                    f"{joint.title}: {_PWM_LIMIT} was changed during this command from {before} to {now}, by another "
                    f"program or a factory reset, and is left as it is{': ' if cut else ''}{', '.join(cut)}. "
                    f"To change it back, use DYNAMIXEL Wizard 2.0{later}."
                )

    def _changed_meaning(self, silent: Collection[Joint]) -> Iterator[str]:
        """Say which settings were changed meanwhile that give angles or goals another meaning: the next start takes
        them as they are.
        """
        for joint, servo in self.bus.drives.items():
            for name in (_OFFSET, _DRIVE_MODE):
                before = self.settings.get((joint, name))
                if before is None or joint in silent:
                    continue
                with suppress(DriverError):
                    if (now := servo.read(name)) != before and servo.read(name) == now:
                        yield (
                            f"{joint.title}: {name} was changed during this command from {before} to {now}, by another "
                            f"program or a factory reset, and is left as it is. Set it back to {before} with DYNAMIXEL "
                            "Wizard 2.0 before the next start."
                        )

    def _put_back(self, joints: Iterable[Joint]) -> dict[Joint, DriverError]:
        """Restore the settings of these joints; return the error of each joint that failed."""
        failed: dict[Joint, DriverError] = {}
        for joint in joints:
            try:
                self.bus.confirm_later(joint)
                servo, settings = self.bus.drives[joint], self._wanted[joint]
                self._check_model(servo)
                put_back(servo, settings)
                possible = attainable(servo, settings)
                self._cut[joint] = {name: value for name, value in possible.items() if value != settings[name]}
            except DriverError as error:
                failed[joint] = error
        return failed

    def _check_model(self, servo: Servo) -> None:
        """Raise WrongModel if a servo of another model answers at this servo's ID."""
        found = servo.read_despite_error("Model Number")
        if found == servo.table.number:
            return
        said = f"{servo.title}: a servo of a different model now answers at this ID."
        if found in {other.table.number for other in self.bus.drives.values()}:
            said += " Another joint has a servo of that model: their IDs may have been swapped."
        raise WrongModel(said)

    def _forget(self, restored: Iterable[Joint]) -> None:
        """Remove the files of servos whose settings have been restored; not where a goal or limit has yet to be."""
        for joint in restored:
            if joint not in self._refused and (not self._cut[joint] or joint in self._left):
                settings_file.forget(self._kept[joint])


def _where(paths: Sequence[Path]) -> str:
    """The file that holds the settings of a servo; for several servos, their folder."""
    return str(paths[0]) if len(paths) == 1 else f"{len(paths)} files in {paths[0].parent}"


_outermost: ContextVar[ServoSession | None] = ContextVar("_outermost", default=None)


@contextmanager
def servo_session(config: Config, folder: Path | None = None, say: Say = to_stderr) -> Iterator[ServoBus]:
    """Open the bus with every servo in its mode and torque off, prepared for exchanges; restore settings at the end.

    Raises ExperimentError at the end if a setting could not be restored and no other error has ended the block.

    A TorqueNotOff that leaves the block reports the final state: servos that answer again are read back. If torque is
    off on all servos, the error that had ended the block is raised instead.

    folder: run folder that receives a copy of the settings. say: receives messages for the user. Raises the same errors
    as `ServoBus.open`, and RunFolderError.
    """
    outer = _outermost.get()
    if outer is not None and outer.bus.port.is_open and outer.bus.config.is_same_arm(config.bus):
        outer.bus.config = config.bus
        outer.shared += 1
        outer.bus.refuse_switched_on()
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
            bus.release_held()  # saving the settings has taken time
            bus.prepare()
            yield bus
        except BaseException as error:
            stopped = error
            raise
        finally:
            _outermost.reset(token)
            told = str(bus.torque_off_report)
            with signals_held_back():
                left = session.end()
            _end_with(bus, stopped, left, told)


def _end_with(bus: ServoBus, stopped: BaseException | None, left: Sequence[str], told: str) -> None:
    """Add what is left to say to the exception that ended the block, or raise another one where it does not apply.

    told: the sentence about torque before the settings were restored.
    """
    report = bus.torque_off_report
    instead: BaseException | None = None
    if isinstance(stopped, TorqueNotOff):
        instead = confirmed_later(bus, stopped)
    elif report is not None and not report.is_off:
        instead = TorqueNotOff(str(report))
        if stopped is not None:
            _retract(stopped, told)
            instead.last_samples = getattr(stopped, "last_samples", None)
    if ended := instead or stopped:
        for line in left:  # after what stopped the arm and the state of its torque, which matter more
            ended.add_note(line)
    elif left:
        raise ExperimentError(" ".join(left))
    if isinstance(instead, TorqueNotOff):
        raise instead
    if instead is not None:
        raise instead from None


def _retract(stopped: BaseException, told: str) -> None:
    """Remove a sentence about torque that no longer holds from an exception's notes."""
    if notes := getattr(stopped, "__notes__", None):
        notes[:] = [rest for note in notes if (rest := note.replace(told, "").strip())]


def confirmed_later(bus: ServoBus, error: TorqueNotOff) -> BaseException | None:
    """The exception to raise in place of `error` if torque is off on all servos by now; None if it is not.

    It is the exception that led to cutting torque. If there was none, and replies were only missing when torque was cut
    at the end, it is an ExperimentError. A note about the torque state is attached to it.
    """
    report = bus.torque_off_report
    error.args = (str(report),)
    if report is None or not report.is_off:
        return None
    cause = error.__context__ or ExperimentError(_LATE_CONFIRMED)
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
        told = any(_TELLS_OF_TORQUE.search(note) for note in getattr(ended, "__notes__", []))
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
    return "Torque is off on all servos, confirmed by reading it back; this command has not switched it on."


def has_moved() -> bool:
    """Whether an earlier run of this session may have left the arm away from its rest pose, held by friction."""
    outer = _outermost.get()
    return outer is not None and outer.shared > 1


def settings_at_start() -> Settings:
    """The servos' settings at the beginning of this session (`changed_settings.settings_now`)."""
    outer = _outermost.get()
    return {} if outer is None else outer.settings


def lay_at_start() -> Lies:
    """Positions of the servos at the beginning of this session; empty if a run may have moved the arm since."""
    outer = _outermost.get()
    return {} if outer is None or outer.shared > 1 else outer.lay
