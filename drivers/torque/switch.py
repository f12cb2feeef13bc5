"""Switching the torque of an arm's servos on and off."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress

from hil.drivers.errors import BusShared, DriverError, ServoFault, ServoRefused, TorqueNotOff
from hil.drivers.joint import Joint
from hil.drivers.packet import HardwareError
from hil.drivers.port import GROWTH, Port
from hil.drivers.preparation.prepare import fault_text, shuts_down
from hil.drivers.servo import Servo, describe_error
from hil.drivers.servo_model import WATCHDOG_UNIT
from hil.drivers.torque.held import switched_on
from hil.drivers.torque.off import (
    TorqueOff,
    cut_again,
    cut_torque,
    disarm_watchdogs,
    is_torque_on,
    signals_held_back,
    tell_torque_off,
    tell_watchdogs,
    was_rebooted,
)

WATCH_S = 0.1
"""Interval at which Torque Enable is read while torque must stay off [s]."""


class TorqueSwitch:
    """Switches torque on and off for all servos on one port together.

    servos: the servos in bus order, keyed by single-servo joints. After any error, the same object can still cut
    torque; `torque_off_report` then shows whether that succeeded.
    """

    def __init__(self, port: Port, servos: Mapping[Joint, Servo]) -> None:
        self.port = port
        self._servos = servos
        self._without_watchdog: set[Joint] = set()
        self._watchdog = 0.0
        self._armed: set[Joint] = set()
        """Servos whose Bus Watchdog has been armed and not disarmed since."""
        self.torque_off_report: TorqueOff | None = None
        self.has_switched_on = False
        """Whether this program has switched torque on since the port was opened."""

    @property
    def drives(self) -> Mapping[Joint, Servo]:
        """All servos, each keyed by a single-servo joint from `Joint.drives`, in bus order."""
        return self._servos

    def _silent(self) -> set[Joint]:
        """Return the servos that did not answer the last request."""
        return set()

    def refuse_switched_on(self) -> None:
        """Check that torque is still off, after this program has found it off or switched it off.

        If torque is on, another program has switched it on. In that case, this method cuts torque on all servos and
        raises BusShared, or TorqueNotOff if torque off could not be confirmed.
        """
        if not (found := switched_on(self._servos)):
            return
        try:
            raise BusShared(
                f"{found}: torque was off and has been switched on by another program, which is driving the arm. End "
                "that program, or unplug its controller, then start again."
            )
        finally:
            report = self.torque_off()
            if report.unconfirmed:
                raise TorqueNotOff(str(report))

    def wait_switched_off(self, until: float) -> None:
        """Wait until the time `until` [s, on the port's clock]; meanwhile, call `refuse_switched_on` every WATCH_S."""
        clock = self.port.clock
        self.refuse_switched_on()
        while (now := clock.now()) < until:
            clock.wait_until(min(until, now + WATCH_S))
            self.refuse_switched_on()

    @property
    def is_watched(self) -> bool:
        """Whether the watchdog of any servo is armed."""
        return bool(self._armed)

    @property
    def armed_ticks(self) -> int:
        """Value written to arm the Bus Watchdogs [20 ms]."""
        return round(self._watchdog / WATCHDOG_UNIT)

    @contextmanager
    def torque(self, watchdog: float) -> Iterator[None]:
        """Switch torque on for the `with` block and off afterwards, however the block exits.

        watchdog: time without packets after which a servo stops by itself [s] (in steps of 20 ms, at most 2.54 s).
        Raises BusShared if another program has switched torque on; TorqueNotOff on exit if torque off could not be
        confirmed (see `torque_off_report`).
        """
        self.refuse_switched_on()
        self.torque_off_report = None
        try:
            self._torque_on(watchdog)
            yield
        finally:
            # There must be no statement between `finally` and `try`: an interrupt before torque_off must be caught.
            try:
                report = self.torque_off()
            except BaseException:
                if self.torque_off_report is None:
                    self.torque_off()
                raise
            if report.unconfirmed:
                raise TorqueNotOff(str(report))

    def _torque_on(self, watchdog: float) -> None:
        ticks = round(watchdog / WATCHDOG_UNIT)
        if not 1 <= ticks <= 127:
            raise ValueError(f"watchdog must be 0.02 to 2.54 s, not {watchdog}")
        self._watchdog = watchdog
        self.port.late_replies, self.port.growth = 0, 1  # late replies during set-up explain nothing later
        for joint, servo in self._servos.items():
            watched = joint not in self._without_watchdog
            if watched:
                servo.write("Bus Watchdog", 0)
            # A change of Operating Mode leaves Goal Current at Current Limit, so it is zeroed before torque is on.
            servo.write(joint.mode.goal_register, 0)
            if watched:
                servo.write("Bus Watchdog", ticks)
                self._armed.add(joint)
        self.has_switched_on = True
        for joint, servo in self._servos.items():
            try:
                servo.write("Torque Enable", 1)
            except ServoRefused:
                if servo.hardware_error() != HardwareError(0):
                    raise ServoFault(self._fault(joint, its_own=True)) from None
                raise

    def torque_off(self) -> TorqueOff:
        """Cut torque on every servo and read it back (`hil.drivers.torque.off`), even if some servos fail.

        Signals are held back in the meantime. An interrupt that nevertheless arrives is raised only after all servos
        have been tried and `torque_off_report` has been set.
        """
        interrupts: list[BaseException] = []
        with signals_held_back():
            silent = self._silent()
            confirmed, unconfirmed = cut_torque(self.port, self._servos, silent, self._watchdog, interrupts)
            self.port.growth = GROWTH
            fell_silent = {joint: self._servos[joint] for joint in confirmed if joint in silent & self._armed}
            reset = {joint: was_rebooted(servo) for joint, servo in fell_silent.items()}
            watched = {joint: self._servos[joint] for joint in confirmed if joint not in self._without_watchdog}
            tripped = disarm_watchdogs(watched, interrupts)
            self._armed.difference_update(watched)
            unwatched = frozenset(self._without_watchdog)
            rebooted, disarmed = (frozenset(joint for joint in reset if reset[joint] is each) for each in (True, False))
            self.torque_off_report = TorqueOff(confirmed, unconfirmed, unwatched, rebooted, disarmed, tripped=tripped)
        if interrupts:
            raise interrupts[0]
        return self.torque_off_report

    def shorten_watchdogs(self, seconds: float) -> None:
        """Shorten the timeouts of the armed Bus Watchdogs to `seconds` [s] until torque is off; leave shorter timeouts
        unchanged.

        Nothing is read back: a servo that misses the packet keeps its previous timeout.
        """
        if seconds < self._watchdog:
            self._tell_watchdogs(seconds)

    def rearm_watchdogs(self) -> None:
        """Rearm the Bus Watchdogs after another program has changed them. Nothing is read back."""
        self._tell_watchdogs(self._watchdog)

    def _tell_watchdogs(self, seconds: float) -> None:
        tell_watchdogs(self.port, {drive: self._servos[drive] for drive in self._armed}, seconds)

    def repeat_torque_off(self) -> None:
        """Send torque off to all servos once more without waiting for an answer, in case a silent servo receives it."""
        with suppress(DriverError):
            tell_torque_off(self.port, self._servos)

    def torque_now(self) -> dict[Joint, bool | None]:
        """Read whether each servo's torque is on (None if unknown), except for servos reported as unconfirmed."""
        report = self.torque_off_report
        unconfirmed = set() if report is None else {joint for joint, _ in report.unconfirmed}
        return {joint: is_torque_on(servo) for joint, servo in self._servos.items() if joint not in unconfirmed}

    def has_torque(self) -> bool:
        """Read, outside the control cycle, whether the torque of all servos is on; False if a servo does not answer."""
        return all(is_torque_on(servo) for servo in self._servos.values())

    def cut_foreign_torque(self, on: Collection[Joint]) -> None:
        """Cut torque that another program has switched on since `torque_off`; `torque_now` then shows the outcome."""
        interrupts: list[BaseException] = []
        with signals_held_back():
            cut_torque(self.port, {joint: self._servos[joint] for joint in on}, (), 0.0, interrupts)
        if interrupts:
            raise interrupts[0]

    def zero_own_goals(self, on: Collection[Joint]) -> None:
        """Zero the goals of servos that are still in this program's mode, so that they do not follow its last goals."""
        for drive in on:
            with suppress(DriverError):
                servo = self._servos[drive]
                if servo.read_despite_error("Operating Mode") == drive.mode:
                    servo.write_despite_error(drive.mode.goal_register, 0)

    def report_doubted(self, drive: Joint, why: str) -> None:
        """Record in `torque_off_report` that a servo (a key of `drives`) does not behave as if its torque were off."""
        report = self.torque_off_report or TorqueOff(tuple(self._servos), ())
        self.torque_off_report = report.with_doubted(drive, why)

    def report_driven(self, on: Collection[Joint], silent: Collection[Joint]) -> None:
        """Record in `torque_off_report` that another program keeps torque on (`TorqueOff.with_driven`)."""
        report = self.torque_off_report or TorqueOff(tuple(self._servos), ())
        self.torque_off_report = report.with_driven(on, silent)

    def confirm_later(self, drive: Joint) -> bool:
        """Cut the torque of a servo (a key of `drives`) that `torque_off` could not confirm as off, and read it back.

        Returns False if there was nothing to do; otherwise, `torque_off_report` lists the servo as confirmed
        afterwards. Raises DriverError if the servo still does not answer.
        """
        report = self.torque_off_report
        if report is None or drive not in [joint for joint, _ in report.unconfirmed]:
            return False
        rebooted = cut_again(self._servos[drive], armed=drive in self._armed)
        self._armed.discard(drive)
        self.torque_off_report = report.with_later(drive, rebooted=rebooted)
        return True

    def _fault(self, drive: Joint, *, its_own: bool) -> str:
        """Return the message for a servo's fault, or "" if it reports no fault and the alert came from another servo.

        its_own: whether this servo itself has raised the alert.
        """
        try:
            error = self._servos[drive].hardware_error()
            cause = describe_error(error)
        except DriverError as problem:
            return fault_text(drive, f"unknown; it could not be read ({problem})")
        cuts = True
        with suppress(DriverError):
            cuts = not error or shuts_down(self._servos[drive], error)
        return fault_text(drive, cause, shuts_down=cuts) if its_own or error else ""
