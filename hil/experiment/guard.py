"""Checks every sample and stops the arm when a limit is exceeded or a reply is inconsistent.

The checks take a few us per sample. The per-joint checks form one compiled loop (`checks.joint_checks`), which also
applies `following` (whether the motor carries the commanded current), `consistency` (whether position and velocity
agree) and `work` (whether the motor turns as commanded); `checks.joint_faults` explains the faults that these checks
find. Other modules check the status registers (`status_check`) and the time without commands or replies (`deadlines`
and `silence`); `command_limits` clamps what is sent.
"""

from collections.abc import Callable, Sequence
from math import isnan
from typing import NoReturn

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.others.read_back import LOST_GOALS, LOST_OF
from hil.drivers.packet import ALERT, StatusError
from hil.drivers.servo import describe_status_error
from hil.drivers.servo_model import Mode
from hil.drivers.state import Slow, State, Status
from hil.errors import Cause, SafetyStop, Unheard
from hil.experiment.checks import following, joint_checks, work
from hil.experiment.checks.apart import Apart
from hil.experiment.checks.current_noise import NoiseAllowance
from hil.experiment.checks.joint_checks import JOINT, MOST_OUTSIDE_RAD, JointChecks
from hil.experiment.checks.joint_faults import JointFaults
from hil.experiment.command_limits import CommandLimits
from hil.experiment.deadlines import Deadlines
from hil.experiment.held_at_rest import HeldAtRest
from hil.experiment.silence import Silence
from hil.experiment.status_check import OLD_REPLIES, TORQUE_LOST, StatusCheck
from hil.plan.find_torque import how_to_find_torque
from hil.plan.recent_motion import RecentMotion

__all__ = ["MOST_OUTSIDE_RAD", "Guard"]

JUMP_FACTOR = 1.5
"""Distance that a joint may appear to move between two samples, relative to what its velocity limit allows."""

EARLY_MOTION_RAD = 0.05
"""Largest motion allowed while the arm rests before the start [rad]."""

_ERRORS_IN_A_ROW = 3
"""If this many consecutive replies of a servo contain both values and an error number, the arm is stopped: the servo
may be rejecting its goals.
"""


class Guard:
    """Compares each sample with the limits of the configuration. `look` raises SafetyStop.

    planned: largest planned goal of each joint [A, or V in PWM mode]; by default, from the configuration.

    interval: time between two exchanges [s]; by default, the sample period. patience: how long an exchange waits
    for missing replies [s].

    heard_instead: returns a message about what arrived instead of replies, with advice; "" if nothing did.

    left_by_a_run: whether the arm is where an immediately preceding run left it. If that run was stopped at a limit, a
    joint may have come to rest slightly beyond it: such a joint may move back, but no farther out.

    recent: the exchanges so far, if another guard checked these.

    lowers_since: for an arm that is being lowered, the time of the last exchange that all servos answered [s]. Replies
    may then be missing for longer; temperatures, voltages and alerts are accepted as long as the servos keep their
    torque, and no advice about the experiment's torque is given.

    noise: noise of each joint's current readings [A or V], if another guard has measured it.
    """

    def __init__(
        self,
        config: Config,
        planned: Sequence[float] | None = None,
        *,
        interval: float | None = None,
        patience: float = 0.0,
        heard_instead: Callable[[], str] = str,
        left_by_a_run: bool = False,
        recent: RecentMotion | None = None,
        lowers_since: float | None = None,
        noise: Sequence[float] | None = None,
    ) -> None:
        rate = config.experiment.rate
        safety = config.safety
        self._seconds = [[second.id for second in joint.joint.seconds] for joint in config.joints]
        self._names = [str(joint.joint) for joint in config.joints]
        self._safety = safety
        self._left_by_a_run = left_by_a_run
        # After a stop at a limit, a pilot lowers the torque itself.
        self._is_lowering = is_lowering = lowers_since is not None
        lower = (
            ""
            if config.experiment.pilot or is_lowering
            else f" Lower experiment.peak_torque, unless something pushed the arm. {how_to_find_torque(config)}"
        )
        self._lower_torque = lower
        commands = CommandLimits(config)
        self.clamp = commands.clamp
        """Clamp goals to each joint's limit and slew rate [A or V]. Raises SafetyStop for a goal that is not finite."""
        self.holding = commands.holding
        """Store the goals now in effect [A or V]; `clamp` limits the next change relative to these."""
        planned = planned or _planned(config)
        interval = 1.0 / rate if interval is None else interval
        self.recent = RecentMotion(config, interval) if recent is None else recent
        """The latest exchanges, including those made while the arm is being stopped."""
        self._silence = Silence(config, interval, patience, lowers_since)
        self._patience = patience or float("inf")
        self._heard_instead = heard_instead
        self._deadlines = Deadlines(config, heard_instead, any_share=is_lowering)
        self._longest_gap = safety.watchdog
        self._joints = _joint_records(config, planned, left_by_a_run)
        self._noise = NoiseAllowance(self._joints, config, planned, interval, noise)
        self._checks = JointChecks(self._joints, interval)
        self._apart = Apart()
        self._status = StatusCheck(config, heard_instead, bears_errors=is_lowering)
        self._faults = JointFaults(config, self._joints, self.recent, self._status, lower)
        self._missing = self._silence.counts
        self._errors = [0] * len(config.joints)
        """Number of consecutive replies that contained both values and an error number, by joint."""
        self._was_irregular = False
        """Whether, in the previous exchange, any reply was missing or reported an error."""
        self._resting: Sequence[float] | None = None
        self._held: HeldAtRest | None = None
        self._config = config
        self._shortest = float("inf")

    def woke_up(self, now: float, late: float) -> None:
        """Record that this program woke up at `now` [s], `late` [s] after the intended time (negative: earlier)."""
        self._silence.woke_up(now, late)

    def others_answer(self) -> None:
        """Record that some servos seem silent only because a silent servo hides their replies."""
        self._silence.others_answer = True

    def late(self, seconds: float = 0.0) -> None:
        """Record a missed deadline, `seconds` after the last command. Raises SafetyStop if the gap is too long."""
        self._deadlines.missed(seconds, waited=any(self._missing))

    def look(self, state: State, watchdog_gap: float = 0.0, *, between: bool = False) -> None:
        """Check one exchange. Raises SafetyStop when a limit is exceeded or a reply is inconsistent.

        watchdog_gap: time since the previous exchange [s]. between: whether this exchange took place between two
        samples.
        """
        now, after, goals, _, _, _, error, missing, slow, status, apart = state
        self.recent.add(state)
        self._status.sent(goals)
        took = after - now
        gap = watchdog_gap if watchdog_gap > took else took
        if gap > self._status.longest_gap:
            self._status.longest_gap = gap
        if gap >= self._longest_gap:
            self._deadlines.check_gap(gap)
        if took > self._patience:
            self._silence.woke_up(now, took - self._patience)
        if took < self._shortest:
            self._shortest = took
        if self._deadlines.any_missed and not between:
            self._deadlines.met()
        if self._was_irregular or True in missing or any(error):
            self._look_one_by_one(state, took - self._shortest)
        else:
            fault = self._checks.look(state, took - self._shortest)
            if fault != joint_checks.FINE:
                self._stop(*self._faults.of(fault, state))
            self._silence.all_heard(now)
        if apart is not None and (turned := self._apart.look(apart)) is not None:
            self._not_together(*turned, state)
        if slow is not None:
            self._look_slow(slow)
            self._look_at_clocks(slow, now)
        if status is not None:
            self._look_status(status, state)

    @property
    def wants_status(self) -> bool:
        """Whether the servos' status should be read again in the next exchange."""
        return self._status.is_in_doubt

    def _look_one_by_one(self, state: State, unsure: float) -> None:
        """Check the joints individually, in an exchange in which replies are missing or report errors, and in the next
        one.
        """
        now, missing, error = state.time_before_write, state.missing, state.error
        self._silence.ask(now)
        # While the arm is being lowered, waiting for replies may take up much of the allowed time.
        silent = state.time_after_read if self._is_lowering else now
        for index in range(len(missing)):
            if error[index] & ALERT and not self._is_lowering:
                self._stop(
                    index, Cause.ALERT, "raised its alert: read Hardware Error Status, find the cause, then reboot it."
                )
            if missing[index]:
                self._count_missing(index, error[index], silent, alone=not all(missing))
                continue
            self._count_errors(index, error[index] & ~ALERT)
            fault = self._checks.look_at(index, state, unsure, self._missing[index])
            if fault != joint_checks.FINE:
                self._stop(*self._faults.of(fault, state))
            self._silence.heard(index, now)
        self._was_irregular = self._silence.any_missed or any(self._errors)

    def _count_errors(self, index: int, error: int) -> None:
        """Count consecutive replies in which a servo reports an error with its values; stop the arm after too many."""
        self._errors[index] = self._errors[index] + 1 if error else 0
        if self._errors[index] >= _ERRORS_IN_A_ROW:
            self._stop(
                index,
                Cause.ERRORS,
                f"reports an error ({describe_status_error(error)}) with its values, {_ERRORS_IN_A_ROW} times in a "
                "row, although no packet sent to it should cause one. Whether it accepts its goals is unknown. "
                "Power-cycle it and check its firmware. A device between adapter and servo may also be changing "
                "its replies.",
            )

    def goals_are_lost(self, index: int, held: str) -> NoReturn:
        """Raise SafetyStop for a joint that misses many goals; `held` says what was read back."""
        if self.recent.is_old(index):
            self._stop(index, *OLD_REPLIES)
        self._stop(
            index,
            Cause.GOALS_LOST,
            f"does not accept goals: {held}, and it missed {LOST_GOALS} of the last {LOST_OF} goals. "
            f"{self._status.why_lost()}",
        )

    def torque_is_off(self, index: int) -> NoReturn:
        """Raise SafetyStop for a joint whose Torque Enable reads 0."""
        self._stop(index, *TORQUE_LOST)

    def rests_at(self, positions: Sequence[float]) -> None:
        """Store the angles that the joints had before torque was switched on [rad]; without this call, the angles in
        the first sample are used. After this call, `measure_noise` must be called with each exchange until
        `noise_is_known`.
        """
        self._resting = positions
        self._noise.begin()

    def measure_noise(self, state: State) -> None:
        """Process an exchange while the arm is at rest: until the noise is known, readings of the motor current may
        deviate by any amount.
        """
        self._noise.add(state)

    def noise_is_known(self) -> list[str]:
        """End the noise measurement; return a message for each joint whose current reading is noisy.

        Raises SafetyStop if a reading is too noisy for the current to be checked.
        """
        noisy = self._noise.end()
        for joint in noisy:
            if joint.refused:
                self._stop(joint.index, Cause.NOT_FOLLOWING, f"cannot be monitored: {joint.said}. {joint.refused}")
        return [f"{self._names[joint.index]}: {joint.said}" for joint in noisy]

    @property
    def current_noise(self) -> Sequence[float]:
        """Noise of each joint's current readings, or its upper bound [A or V]; 0 if not known."""
        return self._noise.noise

    def look_at_rest(self, state: State) -> None:
        """Raise SafetyStop when a joint moves before anything has been commanded."""
        if self._resting is None:
            if not any(state.missing):
                self._resting = state.position
            return
        for index, (first, now) in enumerate(zip(self._resting, state.position, strict=True)):
            if abs(now - first) > EARLY_MOTION_RAD:
                self._stop(
                    index,
                    Cause.EARLY_MOTION,
                    f"moved before the start: {now - first:+.3f} rad without any current; at most {EARLY_MOTION_RAD} "
                    f"is allowed. {self._still_swings()} {self._else_moved(state.velocity[index])}",
                )

    def look_while_held(self, state: State) -> None:
        """Raise SafetyStop if a joint leaves its rest pose although only the stabiliser drives the arm."""
        if self._held is None:
            if not any(state.missing):
                self._held = HeldAtRest(self._config, self._resting or state.position)
        elif not any(state.missing) and (found := self._held.look(state.position)) is not None:
            index, said = found
            self._stop(index, Cause.EARLY_MOTION, said)

    def _else_moved(self, velocity: float) -> str:
        """Name possible causes, other than swinging, of a joint's motion before the start. velocity: its velocity
        [rad/s].
        """
        if abs(velocity) < self._safety.rest_velocity:
            return (
                f"Otherwise, since it is not moving now ({velocity:+.2f} rad/s), check its encoder and magnet, and "
                "whether its horn has slipped or something has moved it."
            )
        return (
            f"Otherwise, since it moves at {velocity:+.2f} rad/s, check whether a hand or a cable pushes or holds it, "
            "whether its horn slips, or whether another program is commanding it."
        )

    def _still_swings(self) -> str:
        """Return advice for an arm that has not come to rest."""
        if not self._left_by_a_run:
            return "If it is still swinging, as an arm with little friction may be, wait until it is at rest."
        longer = f"raise safety.rest_time ({self._safety.rest_time:g} s)"
        return f"If it is still swinging after the previous run, as an arm with little friction may be, {longer}."

    def look_at_supply(self, index: int, lacking: float, recent: Sequence[State]) -> None:
        """Raise SafetyStop if the measured current shows that the supply explains a joint's missing torque [N m]."""
        if (fault := self._faults.lack_of_voltage(index, lacking, recent)) is not None:
            self._stop(index, *fault)

    def does_not_repeat(self, index: int, position: float) -> NoReturn:
        """Raise SafetyStop for a joint that is at `position` [rad], not where it was one period ago."""
        self._stop(
            index,
            Cause.UNLIKE_BEFORE,
            f"does not repeat its motion: under the same torque it is at {position:.3f} rad, far from where it was one "
            "period ago. Something is pushing or holding it, its load has changed, it slips, or its encoder has "
            f"failed. If none of these applies, it swings so far that its motion never repeats.{self._lower_torque}",
        )

    def _count_missing(self, index: int, error: int, now: float, *, alone: bool) -> None:
        # An error with a valid checksum is an answer, not a lost packet: one is enough, unless it reports that the
        # request was damaged.
        refused = bool(error) and error != StatusError.CRC
        too_long = self._silence.missed(index, now, answered=bool(error), refused=refused, alone=alone)
        if too_long is None:
            return
        if error:
            self._stop(
                index,
                Cause.MISSING,
                f"answers with an error ({describe_status_error(error)}) instead of its state; its last state came "
                f"{too_long}. It refuses reads: power-cycle it.",
            )
        what = f"missed {self._missing[index]} replies in a row; its last reply came {too_long}."
        if heard := self._heard_instead():
            self._stop(index, Cause.MISSING, f"{what} {heard}")
        unheard = Unheard.ONE if len(self._missing) == 1 or not all(self._missing) else Unheard.ALL
        stop = SafetyStop(f"{self._title(index)} {what}", Cause.MISSING, self._silence_remedy(unheard))
        stop.unheard = unheard
        raise stop

    def _silence_remedy(self, unheard: Unheard) -> str:
        if unheard is Unheard.ONE:
            return "Requests or replies are lost: check its cable and its supply."
        # A silent servo also hides the replies of those after it; which servos answer is found out once torque is off.
        shared = "No servo replied; requests or replies are lost: check the adapter, the cables and the supply"
        if self._silence.is_busy:
            return f"{shared}, and whether other programs keep this computer busy, since this program was running late."
        return f"{shared}."

    def _not_together(self, index: int, servo: int, turned: float, state: State) -> NoReturn:
        ids = self._seconds[index]
        slips = "Its horn slips, a screw is loose, one of the encoders is wrong, or its direction setting is wrong."
        self._stop(
            index,
            Cause.APART,
            f"has servos that no longer turn together: ID {ids[servo]} has turned {turned:+.3f} rad relative to the "
            f"first one since the start. {self._faults.swapped(index, state) or slips}",
        )

    def _look_at_clocks(self, slow: Slow, now: float) -> None:
        for index, tick in enumerate(slow.tick):
            if not isnan(tick) and (wrong := self._status.look_at_clock(index, tick, now)) is not None:
                self._stop(index, *wrong)

    def _look_status(self, told: Sequence[Status | None], state: State) -> None:
        for index, status in enumerate(told):
            if status is None:
                continue
            wrong = self._status.look(index, status, state.goal_current[index], state.time_before_write)
            if wrong is not None:
                self._stop(index, *wrong)

    def watchdog_reads(self, index: int, ticks: int) -> None:
        """Raise SafetyStop for a joint whose Bus Watchdog reads `ticks` [20 ms] if that is not the value required."""
        if (wrong := self._status.look_at_watchdog(ticks)) is not None:
            self._stop(index, *wrong)

    def _look_slow(self, slow: Slow) -> None:
        safety = self._safety
        if self._is_lowering:
            return  # the servos protect themselves, and holding on for seconds is better than dropping the arm
        for index, (celsius, volt) in enumerate(zip(slow.temperature, slow.voltage, strict=True)):
            if volt > 0.0 and not volt >= self._faults.supply[index]:
                self._faults.supply[index] = volt
            if celsius > safety.max_temperature:
                self._stop(
                    index,
                    Cause.TEMPERATURE,
                    f"is at {celsius:.0f} degrees C; safety.max_temperature is {safety.max_temperature:g}. Let it "
                    "cool.",
                )
            if volt < safety.min_voltage or volt > safety.max_voltage:
                self._stop(
                    index,
                    Cause.VOLTAGE,
                    f"has a supply voltage of {volt:.1f} V; safety.min_voltage and max_voltage allow "
                    f"{safety.min_voltage:g} to {safety.max_voltage:g}. Check the supply.",
                )

    def _stop(self, index: int, cause: Cause, what: str) -> NoReturn:
        raise SafetyStop(f"{self._title(index)} {what}", cause)

    def _title(self, index: int) -> str:
        name = self._names[index]
        return f"{name[0].upper()}{name[1:]}"


def _joint_records(config: Config, planned: Sequence[float], left_by_a_run: bool) -> np.ndarray:
    """Return the joints' records for `joint_checks`."""
    joints = np.zeros(len(config.joints), JOINT)
    safety = config.safety
    for record, joint, peak in zip(joints, config.joints, planned, strict=True):
        record["low"], record["high"] = joint.position_limit
        record["fastest"], record["farthest"] = joint.velocity_limit, JUMP_FACTOR * joint.velocity_limit
        record["may_start_outside"] = left_by_a_run
        record["is_followed"] = not _measures_supply(joint)
        record["is_worked"] = config.stabiliser is None
        following.begin(record["following"], record["goals"], joint, peak, safety.follow_share, safety.follow_time)
        work.begin(record["work"], joint.torque_per_goal, peak)
    return joints


def _measures_supply(joint: JointConfig) -> bool:
    """Whether the servo reports the supply current instead of the motor current; in that case, only motion and status
    are checked.
    """
    return joint.drive_mode is Mode.CURRENT and joint.joint.servo.senses_supply


def _planned(config: Config) -> list[float]:
    """Largest configured goals [A or V]; the current limits if no torque is configured."""
    peaks = config.experiment.peak_torque
    if peaks is None:
        return [joint.goal_limit for joint in config.joints]
    return [peak / joint.torque_per_goal for joint, peak in zip(config.joints, peaks, strict=True)]
