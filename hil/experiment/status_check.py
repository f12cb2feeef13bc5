"""What servos tell of themselves beside their state: driven, watched, taking their goals, and answering of now?

None of this shows in a reply's position and velocity, and in its current only where the servo has a sensor in its
motor. The registers are read back a few times in 0.1 s (hil.drivers.bus), so each of these faults is seen in 0.1 s.
"""

from hil.config.schema import Config
from hil.drivers.packet import HardwareError
from hil.drivers.servo import describe_error
from hil.drivers.servo_model import WATCHDOG_UNIT
from hil.drivers.state import Status
from hil.errors import Cause

_TRIPPED = 255
_WRAP_S = 32.768
_CLOCK_TOLERANCE_S = 0.05
"""By how much a servo's clock may differ from the computer's between two readings: its replies' own delay included."""

_CLOCK_DRIFT = 0.01
_GOALS_MISSED = 2
"""Times in a row that a goal may not have arrived: one packet may get lost."""


class StatusCheck:
    """Compares what servos tell with what they were told. `look` gives what is wrong, or None."""

    def __init__(self, config: Config) -> None:
        self._armed = round(config.safety.watchdog / WATCHDOG_UNIT)
        self._may_be_unwatched = config.safety.allow_no_watchdog
        self._half_tick = [0.5 * abs(joint.joint.drive_unit(12.0)) for joint in config.joints]
        self._unit = [joint.drive_mode.goal_unit for joint in config.joints]
        self._missed = [0] * len(config.joints)
        self._clock: list[tuple[float, float] | None] = [None] * len(config.joints)

    def look(self, joint: int, status: Status, sent: float, now: float) -> tuple[Cause, str] | None:
        """sent: the joint's goal in the same exchange [A or V]; now: its time [s]. What is wrong, for a sentence."""
        if status.hardware_error:
            error = describe_error(HardwareError(status.hardware_error))
            return Cause.ALERT, f"reports a hardware error: {error}. Find the cause, then switch its supply off and on."
        if status.torque is False:
            return Cause.TORQUE_OFF, (
                "has lost its torque: Torque Enable reads 0 although this program switched it on. It was rebooted, its "
                "supply failed for a moment, or another program uses this bus."
            )
        return self._watchdog(status) or self._goal(joint, status, sent) or self._time(joint, status, now)

    def _watchdog(self, status: Status) -> tuple[Cause, str] | None:
        if status.watchdog == self._armed:
            return None
        if status.watchdog == _TRIPPED:
            return Cause.WATCHDOG, (
                "was stopped by its Bus Watchdog: it heard nothing for "
                f"{1e3 * self._armed * WATCHDOG_UNIT:.0f} ms. Look at its cable; close other programs on this computer."
            )
        if status.watchdog == 0 and self._may_be_unwatched:
            return None
        return Cause.WATCHDOG, (
            f"is no longer watched: its Bus Watchdog reads {status.watchdog}, it was armed with {self._armed}. Another "
            "program uses this bus, or the servo was rebooted."
        )

    def _goal(self, joint: int, status: Status, sent: float) -> tuple[Cause, str] | None:
        if abs(status.goal - sent) < self._half_tick[joint]:
            self._missed[joint] = 0
            return None
        self._missed[joint] += 1
        if self._missed[joint] < _GOALS_MISSED:
            return None
        unit = self._unit[joint]
        return Cause.GOALS_LOST, (
            f"does not take its goals: it holds {status.goal:.3f} {unit} where {sent:.3f} {unit} was sent, and held a "
            "former one before. Packets to it get lost, or it refuses them: look at cable and limits."
        )

    def _time(self, joint: int, status: Status, now: float) -> tuple[Cause, str] | None:
        former, self._clock[joint] = self._clock[joint], (status.tick, now)
        if former is None:
            return None
        elapsed = now - former[1]
        off = (status.tick - former[0] - elapsed + 0.5 * _WRAP_S) % _WRAP_S - 0.5 * _WRAP_S
        if abs(off) <= _CLOCK_TOLERANCE_S + _CLOCK_DRIFT * elapsed:
            return None
        return Cause.STALE, (
            f"does not answer of now: its own clock went on by {1e3 * (elapsed + off):.0f} ms while "
            f"{1e3 * elapsed:.0f} ms passed. Its replies are old ones, held up on their way, or it was rebooted. Look "
            "at the adapter and its cable."
        )
