"""A session with the arm's servos: their settings are saved before the first write and restored after the last.

A session holds the port. A session inside another one for the same arm shares the port, so that the steps of a pilot
write each EEPROM register only once. Each register is also restored only once, when the outermost block ends, whatever
the reason. If a killed program left saved settings behind, these are taken as the servos' original settings and
restored at the end (`killed_run`).
"""

import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from hil import fakes
from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, PortLost, ServoRefused, TorqueDoubted
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import PROTECTIVE, read_settings
from hil.drivers.servo_model import Mode
from hil.drivers.torque.held import FADE_S, SINKING_S, LetDown, Originals, in_current_mode
from hil.drivers.torque.off import and_list, signals_held_back
from hil.drivers.torque.switch import WATCH_S
from hil.errors import ExperimentError
from hil.setup.changed_settings import Settings, settings_now
from hil.setup.session import settings_file
from hil.setup.session.end_of_session import end_with, telling_of_torque
from hil.setup.session.killed_run import REBOOT_S
from hil.setup.session.others import others_on_the_bus
from hil.setup.session.saved_settings import SavedSettings
from hil.setup.session.unrestored import unrestored
from hil.setup.unmoved import Lies, wait_for_rest, where_it_lies

__all__ = [
    "Say",
    "ServoSession",
    "has_moved",
    "lay_at_start",
    "servo_session",
    "settings_at_start",
    "to_stderr",
]

Say = Callable[[str], None]

_MOST_CUTS = 5
"""Largest number of times that torque is cut again at the end if another program switches it on."""

COUNT_DOWN_S = 5.0
"""Time from the warning that the arm will move again, after a stopped run, until torque is switched on [s]."""


def to_stderr(text: str) -> None:
    """Print a message on standard error; standard output may be reserved for results."""
    with suppress(OSError, ValueError):
        print(f"hil: {text}", file=sys.stderr)


@dataclass
class ServoSession:
    """An open bus and the saved settings of its servos; created by `servo_session`."""

    bus: ServoBus
    _say: Say
    saved: SavedSettings
    settings: Settings = field(default_factory=dict)
    """The servos' settings at the beginning of the session, as read by `settings_now`."""
    lay: Lies = field(default_factory=dict)
    """Positions of the servos at the beginning of the session."""
    _delays: dict[Joint, int] = field(default_factory=dict)
    """Return Delay Time of each servo at the beginning of the session [2 us]."""
    _is_ours: bool = False
    """Whether the servos belong to the arm and no other program holds them, so that they may be written to."""
    _on_again: dict[Joint, int] = field(default_factory=dict)
    """Servos whose torque another program has switched on since this program cut it, each with the number of times that
    it was cut again.
    """
    _torque: dict[Joint, bool | None] = field(default_factory=dict)
    """Whether each servo's torque was on at the latest reading; None if unknown (`ServoBus.torque_now`)."""
    shared: int = 0
    """Number of inner sessions that have used the bus."""
    was_stopped: bool = False
    """Whether the last inner session ended with an exception, so that the arm went limp earlier than planned."""

    def begin(self, config: Config, folder: Path | None) -> None:
        """Check that the servos answer and that no other program holds the arm, then save their settings.

        Nothing is written to a servo before its settings are on disk. Raises the same errors as `ServoBus.open`.
        """
        bus = self.bus
        self.saved.look_for_left()
        bus.check_identity()
        down = bus.release_held(ours=self.saved.left_on(), before_lowering=self._before_lowering)
        self._is_ours = True
        if down.joints:
            self._wait_for_rest(down)
        self.lay = where_it_lies(bus)
        if others := others_on_the_bus(bus):
            self._say(f"Also on this bus (left alone): {'; '.join(each.described for each in others)}.")
            for each in others:
                if each.left:
                    self._say(f"{each.name}: {each.left}")
        described = {
            drive: each for joint, each in zip(bus.joints, config.joints, strict=True) for drive in joint.drives
        }
        for joint, servo in bus.drives.items():
            settings = read_settings(servo)
            self._delays[joint] = servo.read("Return Delay Time")
            # If this program is killed, the next one can thus tell whether another has changed a protective setting.
            changed = {name: settings[name] for name in PROTECTIVE if name in settings}
            changed["Operating Mode"] = int(joint.mode)
            if joint.mode is Mode.CURRENT:
                share = described[joint].goal_limit / len(described[joint].ids)
                changed["Current Limit"] = joint.current_limit_ticks(share)
            self.saved.save(joint, settings, changed)
        self.settings = settings_now(bus)
        if folder is not None:
            copies = {str(joint.id): kept.settings for joint, kept in self.saved.kept.items()}
            settings_file.write_durably(folder / settings_file.COPY_NAME, {"port": bus.port.url, "servos": copies})

    def _before_lowering(self, joints: Collection[Joint]) -> Originals:
        """Save the settings of servos that are about to be let down, and announce what will happen."""
        originals = self.saved.save_held(joints)
        self._say(
            f"Torque is on at {and_list(map(str, joints))}. The arm is let down: within {2 * FADE_S:.0f} s, its "
            f"motors' output is reduced to zero; it then sinks, braked by its motors, for at most {SINKING_S:.0f} s, "
            "and torque is cut when it has come to rest. Hold the arm by hand: whether a real motor brakes in this way "
            "has not been tested."
        )
        if unbraked := in_current_mode({joint: self.bus.drives[joint] for joint in joints}):
            self._say(
                f"{and_list(joint.title for joint in unbraked)}: in current mode, the motor brakes only if its "
                "firmware obeys Goal PWM in that mode; otherwise the joint falls freely."
            )
        return originals

    def _wait_for_rest(self, down: LetDown) -> None:
        """Wait until an arm that has been let down is at rest without torque. Raises ExperimentError if it is not."""
        if down.moving:
            self._say(
                f"{and_list(joint.title for joint in down.moving)} had not come to rest after {SINKING_S:.0f} s, when "
                "torque was cut. Hold the arm by hand."
            )
        if moving := wait_for_rest(self.bus):
            raise ExperimentError(moving)

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
        """Restore every servo's settings; return one message for each reason why some could not be restored.

        Torque is read last, and cut again if another program has switched it on since; those servos' settings are then
        restored again. Never raises DriverError.
        """
        saved = self.saved
        failed = saved.put_back(saved.kept)
        while failed and self._cut_again(failed):
            pass
        if failed:
            clock = self.bus.port.clock
            clock.wait_until(clock.now() + REBOOT_S)
            if any(isinstance(error, PortLost) for error in failed.values()):
                self.bus.port.reopen()  # if a hub or an adapter was reset, for example by electrical noise
            failed = saved.put_back(failed)
        saved.verify(failed)
        left = unrestored(saved, failed, self.settings, self._delays, is_ours=self._is_ours)
        while self._cut_again(failed):
            saved.verify(failed)
            left = unrestored(saved, failed, self.settings, self._delays, is_ours=self._is_ours)
        if told := [
            f"{joint}: {name} was {found} and is {restored} again"
            for (joint, name), (found, restored) in saved.undone.items()
            if joint not in failed
        ]:
            self._say(f"Settings that another program had changed have been restored ({'; '.join(told)}).")
        saved.forget(joint for joint in saved.kept if joint not in failed)
        for joint, error in failed.items():
            if isinstance(error, TorqueDoubted):
                self.bus.report_doubted(joint, str(error))
        return [*self._switched_on_by_another(), *left]

    def _cut_again(self, failed: dict[Joint, DriverError]) -> bool:
        """Cut torque where it is on and restore these servos' settings; return whether there was anything to do.

        If another program has already switched torque on again in this session, torque is watched for WATCH_S, because
        a single reading may come too early.

        failed: receives the errors of the servos whose settings could not be restored.
        """
        if not self._is_ours:
            return False
        clock = self.bus.port.clock
        until = clock.now() + (WATCH_S if self._on_again else 0.0)
        while True:
            self._torque = self.bus.torque_now()
            on = [joint for joint, is_on in self._torque.items() if is_on]
            if on or clock.now() >= until:
                break
            clock.wait_until(clock.now() + WATCH_S / 10)
        if not on or max(self._on_again.get(joint, 0) for joint in on) >= _MOST_CUTS:
            return False
        self.bus.cut_foreign_torque(on)
        for joint in on:
            self._on_again[joint] = self._on_again.get(joint, 0) + 1
            failed.pop(joint, None)
        failed |= self.saved.put_back(joint for joint in on if joint in self.saved.kept)
        return True

    def _switched_on_by_another(self) -> Iterator[str]:
        """Name the servos on which another program switched torque on after it had been cut, unless torque is still on
        there.
        """
        on = [joint for joint, is_on in self._torque.items() if is_on]
        silent = [joint for joint in self._on_again if self._torque.get(joint, True) is None]
        if on or silent:
            self.bus.zero_own_goals(on)
            self.bus.report_driven(on, silent)
        if off := [joint for joint in self._on_again if joint not in {*on, *silent}]:
            yield (
                f"Another program switched torque on at {and_list(map(str, off))} before or while the settings were "
                "restored. It was cut again and was still off when it was last read. Stop that program before "
                "you reach into the arm's workspace: it may switch torque on again."
            )


_outermost: ContextVar[ServoSession | None] = ContextVar("_outermost", default=None)


@contextmanager
def servo_session(config: Config, folder: Path | None = None, say: Say = to_stderr) -> Iterator[ServoBus]:
    """Open the bus, ready for exchanges, with torque off and every servo in its mode; restore settings at the end.

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
    with ServoBus.connect(config.bus) as bus, telling_of_torque(bus):
        session = ServoSession(bus, say, SavedSettings(bus, say, str(config.path.absolute())))
        token = _outermost.set(session)
        stopped: BaseException | None = None
        try:
            try:
                session.begin(config, folder)
                bus.refuse_switched_on()  # saving the settings has taken time
                bus.prepare()
                yield bus
            except ServoRefused:
                bus.refuse_switched_on()
                raise
        except BaseException as error:
            stopped = error
            raise
        finally:
            _outermost.reset(token)
            _end(session, stopped)


def _end(session: ServoSession, stopped: BaseException | None) -> None:
    """Restore the settings. Add a report of what could not be restored to the exception that ends the session.

    If a signal arrives meanwhile, its exception ends the session in place of `stopped`, with the same notes.
    """
    bus, before = session.bus, session.bus.torque_off_report
    left: list[str] = []
    try:
        with signals_held_back():
            left = session.end()
            if bus.port.strangers and not isinstance(stopped, BusShared):
                left.append(
                    "Another program sent packets on this bus while the servos were being set up or restored. Stop it "
                    "before you start hil again: it may move the arm."
                )
    except BaseException as signalled:
        for line in getattr(stopped, "__notes__", []):
            signalled.add_note(line)
        end_with(bus, signalled, left, before)
        raise
    end_with(bus, stopped, left, before)


def has_moved() -> bool:
    """Whether an earlier run of this session may have left the arm away from its rest pose, where friction holds it."""
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
