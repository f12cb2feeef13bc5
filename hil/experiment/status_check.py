"""Checks of a servo's status registers: is torque on, is the watchdog armed, was the goal accepted, is the reply
recent?

None of this shows in position or velocity; it shows in the current only if the servo has a motor current sensor. The
registers are read back several times per 0.1 s (hil.drivers.bus), so each of these faults is detected within 0.1 s.
"""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import islice
from math import nan, remainder

from hil.config.schema import Config
from hil.drivers.others.foreign_values import ForeignValues
from hil.drivers.packet import HardwareError
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import describe_error
from hil.drivers.servo_model import WATCHDOG_UNIT
from hil.drivers.state import Status
from hil.errors import Cause

_WRAP_S = 32.768
"""Period after which a servo's clock starts again [s]. Of two clocks' readings, the difference is thus known up to
multiples of it.
"""

_CLOCK_TOLERANCE_S = 0.004
"""Largest accepted lag of a servo's clock, which counts milliseconds, behind its expected value [s]."""

_TICK_S = 3e-3
"""Time after which a clock that counts milliseconds must have advanced [s]."""

_REBOOTED_S = 1.0  # larger than any delay of a request
_CLOCK_DRIFT = 0.01
_LEARNT_READINGS = 3
_STALE_READINGS = 2
_GOALS_MISSED = 2
"""Number of consecutive mismatches at which goals count as lost: a single lost packet is not a fault."""

_REMEMBERED = 256
"""Number of latest goals kept."""

_LONGEST_DELAY_S = 0.1
"""Longest assumed delay of requests [s]. If a servo reports a goal that was last sent longer ago than this, the
agreement counts as a coincidence.
"""

_HELD_BEFORE = 4
"""If writes are lost, a servo may also hold one of the last `_HELD_BEFORE` goals sent before the latest status that
matched.
"""


OLD_REPLIES = (
    Cause.STALE,
    "returns stale data: its replies do not change, or are late according to its own clock. A device between adapter "
    "and servo repeats or delays them.",
)


TORQUE_LOST = (
    Cause.TORQUE_OFF,
    "has lost its torque: Torque Enable reads 0 although this program switched it on. It was rebooted, its supply "
    "failed for a moment, or another program is using this bus.",
)


class StatusCheck:
    """Compares reported values with the commanded ones. `look` returns the fault, or None.

    heard_instead: as for `Guard`. bears_errors: whether to tolerate a hardware error as long as the servo keeps its
    torque.
    """

    def __init__(self, config: Config, heard_instead: Callable[[], str] = str, *, bears_errors: bool = False) -> None:
        self._heard_instead = heard_instead
        self._bears_errors = bears_errors
        self._interval = 1.0 / config.experiment.rate
        self._armed = round(config.safety.watchdog / WATCHDOG_UNIT)
        self._may_be_unwatched = config.safety.allow_no_watchdog
        self._half_tick = [0.5 * abs(joint.joint.drive_unit(12.0)) for joint in config.joints]
        self._unit = [joint.drive_mode.goal_unit for joint in config.joints]
        self._missed = [0] * len(config.joints)
        self._has_one_servo = [len(joint.ids) == 1 for joint in config.joints]
        self.longest_gap = 0.0
        """Longest time so far for which this program has sent nothing [s]."""
        self._goals: deque[Sequence[float]] = deque(maxlen=_REMEMBERED)
        self._cycles = 0
        # Per joint: goal in the latest status if it differs from that sent [A or V], with the number of goals sent by
        # then; the number of goals sent when they last agreed; and whether a goal that this program did not send was
        # seen since then.
        self._held: list[tuple[float, int] | None] = [None] * len(config.joints)
        self._agreed_at = [0] * len(config.joints)
        self._is_foreign = [False] * len(config.joints)
        self._ticks = [(nan, nan)] * len(config.joints)
        """Servo's and computer's clock readings in the latest status [s], by joint."""
        self._foreign = [ForeignValues() for _ in config.joints]
        """Reported goals that this program never sent, by joint."""
        # Per joint: smallest servo minus computer clock [s], its time [s], readings, consecutive stale readings.
        self._clock = [(0.0, 0.0, 0, 0)] * len(config.joints)

    @property
    def is_in_doubt(self) -> bool:
        """Whether a single lost packet could explain the fault in the latest status. The status should then be read
        again at once.
        """
        return any(self._missed) or any(stale for *_, stale in self._clock)

    def sent(self, goals: Sequence[float]) -> None:
        """Remember the goals (joints,) of an exchange [A or V]."""
        self._goals.append(goals)
        self._cycles += 1

    def other_goal(self, joint: int) -> float | None:
        """The goal in the joint's latest status [A or V] if it differs from the one sent; otherwise None."""
        held = self._held[joint]
        return held and held[0]

    def look(self, joint: int, status: Status, sent: float, now: float) -> tuple[Cause, str] | None:
        """Check a status reading; return the fault's cause and text, or None.

        sent: the joint's goal in the same exchange [A or V]. now: time of the exchange [s].
        """
        if status.hardware_error and not (self._bears_errors and status.torque):
            error = describe_error(HardwareError(status.hardware_error))
            return Cause.ALERT, f"reports a hardware error: {error}. Find the cause, then power-cycle the servo."
        if status.torque is False:
            return TORQUE_LOST
        (tick, seen), self._ticks[joint] = self._ticks[joint], (status.tick, now)
        if watchdog := self.look_at_watchdog(status.watchdog):
            return watchdog
        clock = self.look_at_clock(joint, status.tick, now)
        goal = self._goal(joint, status, sent, now)
        if goal and not clock and ((tick == status.tick and now - seen > _TICK_S) or self._clock[joint][3]):
            return OLD_REPLIES  # an old reply holds an old goal, which proves nothing about the goals
        return clock or goal

    def look_at_watchdog(self, ticks: int) -> tuple[Cause, str] | None:
        """Check a servo's Bus Watchdog [20 ms]; return the fault's cause and text, or None.

        While the arm is being lowered, an unprotected servo is accepted: cutting torque would drop the arm.
        """
        if ticks == self._armed or (self._bears_errors and ticks != WATCHDOG_TRIPPED):
            return None
        if ticks == WATCHDOG_TRIPPED:
            return Cause.WATCHDOG, (
                "has lost its torque: its watchdog tripped (Bus Watchdog reads 255). It received nothing for "
                f"{1e3 * self._armed * WATCHDOG_UNIT:.0f} ms{self._why_tripped()}."
            )
        if self._may_be_unwatched:
            return None
        return Cause.WATCHDOG, (
            f"{_unlike_armed(ticks - self._armed if ticks else 0)}: its Bus Watchdog reads "
            f"{ticks} but was set to {self._armed}. Another program is using this bus"
            f"{'' if ticks else ', or the servo was rebooted'}."
        )

    def _why_tripped(self) -> str:
        """Return why a watchdog may have tripped, given how regularly this program has sent packets."""
        if self.longest_gap > 0.5 * self._armed * WATCHDOG_UNIT:
            return ": check its plug and cable, unless the computer kept this program waiting"
        return ", or another program has set this register: check its plug and cable, and stop other programs"

    def _goal(self, joint: int, status: Status, sent: float, now: float) -> tuple[Cause, str] | None:
        if abs(status.goal - sent) < self._half_tick[joint]:
            self._missed[joint] = 0
            self._held[joint], self._agreed_at[joint], self._is_foreign[joint] = None, self._cycles, False
            return None
        former, self._held[joint] = self._held[joint], (status.goal, self._cycles)
        foreign = self._foreign[joint]
        if self._never_sent(joint, status.goal):
            self._is_foreign[joint] = True
            foreign.add(now)
        is_repeated = foreign.are_proof(now)
        self._missed[joint] += 1
        if self._missed[joint] < _GOALS_MISSED and not is_repeated:
            return None
        if former is not None and (late := self._late(joint, status.goal, *former)):
            cycles = "a cycle" if late == 1 else f"{late} cycles"
            if not self._is_recent(joint, late):
                return Cause.STALE, (
                    f"returns stale data: it holds a goal that it seemed to have missed before, so its replies are "
                    f"{cycles} late. Check the adapter, its latency and its cable."
                )
            if late * self._interval <= _LONGEST_DELAY_S:
                return Cause.GOALS_LOST, (
                    f"receives goals {cycles} late: according to its own clock, its replies are recent. A device "
                    "between adapter and servo delays requests. Check the adapter, its latency and its cable."
                )
        unit = self._unit[joint]
        held = f"it holds {status.goal:.3f} {unit} but {sent:.3f} {unit} was sent"
        if self._is_foreign[joint] or is_repeated:
            return Cause.GOALS_LOST, (
                f"does not hold the goals of this program: {held}, and it has held goals that this program never sent. "
                "Either another program or controller is commanding it (stop that program or unplug that controller), "
                "or goals are being corrupted on the bus (check the adapter and the cable)."
            )
        return Cause.GOALS_LOST, f"does not accept goals: {held}, and it missed an earlier goal too. {self.why_lost()}"

    def _is_recent(self, joint: int, late: int) -> bool:
        """Whether the servo's clock, which shows delays of several ms, rules out replies that are `late` cycles old."""
        readings, stale = self._clock[joint][2:]
        return readings >= _LEARNT_READINGS and not stale and late * self._interval > 2 * _CLOCK_TOLERANCE_S

    def _late(self, joint: int, held: float, former: float, missed_at: int) -> int:
        """Return the smallest delay [cycles] of a servo's replies that explains its goals, 0 if none does.

        held: the goal reported now [A or V]. former: the wrong goal reported before, when `missed_at` goals had been
        sent [A or V]. Replies are late if `held` had already been sent at that time.
        """
        ago = self._cycles - missed_at
        half = self._half_tick[joint]
        for cycles, goals in enumerate(reversed(self._goals)):
            is_held = abs(held - goals[joint]) < half
            if is_held or abs(former - goals[joint]) < half:
                return cycles if is_held and cycles >= ago and abs(held - former) >= half else 0
        return 0

    def why_lost(self) -> str:
        """Return why goals are lost, for example because of unexpected bytes on the wire."""
        refused = (
            "Goals are being lost in transit, the servo refuses them (check its cable and limits), or a device on the "
            "bus repeats its old replies."
        )
        return self._heard_instead() or refused

    def _never_sent(self, joint: int, held: float) -> bool:
        """Whether the goal that a servo holds differs from every goal sent to any joint since the servo's latest
        matching status.

        The halves of a two-servo joint's goal may differ in age, so nothing is known about their sum.
        """
        if not self._has_one_servo[joint]:
            return False
        since = self._cycles - self._agreed_at[joint] + _HELD_BEFORE
        if since > _REMEMBERED:
            return False
        latest = islice(reversed(self._goals), since)
        return all(abs(held - goal) >= self._half_tick[joint] for goals in latest for goal in goals)

    def look_at_clock(self, joint: int, tick: float, now: float) -> tuple[Cause, str] | None:
        """Detect old replies and reboots from the servo's clock; return the fault's cause and text, or None.

        tick: the servo's clock [s]. now: the computer's clock before the request [s]. Because a request may be late, a
        servo's clock may be ahead of its expected value, but it is never behind unless the reply is old. The expected
        value follows from the smallest lead observed so far, which may drift.
        """
        behind, seen_at, readings, stale = self._clock[joint]
        offset = (tick - now) % _WRAP_S
        if readings == 0:
            behind = offset
        ahead = remainder(offset - behind, _WRAP_S)
        drifted = _CLOCK_DRIFT * (now - seen_at)
        if ahead < -_CLOCK_TOLERANCE_S - drifted or ahead > _REBOOTED_S:
            if readings < _LEARNT_READINGS:
                self._clock[joint] = offset, now, 1, 0  # the first requests were late, so this one counts
                return None
            stale += 1
            self._clock[joint] = behind, seen_at, readings, stale
            if stale < _STALE_READINGS:
                return None
            if self._is_anothers(joint, offset, now):
                return Cause.STALE, (
                    "returns another servo's data: its reply carries that servo's clock. Replies are being mixed up. "
                    "Check the adapter, and that every servo has its own ID."
                )
            return Cause.STALE, (
                f"returns stale data: according to its own clock, its reply is {1e3 * abs(ahead):.0f} ms off. Replies "
                "are delayed in transit, or the servo was rebooted. Check the adapter, its latency and its cable."
            )
        least = offset if ahead < drifted else behind + drifted
        self._clock[joint] = least, now, readings + 1, 0
        return None

    def _is_anothers(self, joint: int, offset: float, now: float) -> bool:
        """Whether this clock difference (servo minus computer) is that of another joint's servo."""
        return any(
            readings >= _LEARNT_READINGS
            and abs(remainder(offset - behind, _WRAP_S)) <= _CLOCK_TOLERANCE_S + _CLOCK_DRIFT * (now - seen_at)
            for other, (behind, seen_at, readings, _) in enumerate(self._clock)
            if other != joint
        )


def _unlike_armed(longer: int) -> str:
    """Describe the effect of a changed watchdog timeout. longer: its increase [20 ms]; 0 if the watchdog is off."""
    if not longer:
        return "is no longer protected"
    return f"stops by itself {'later' if longer > 0 else 'earlier'} than intended"
