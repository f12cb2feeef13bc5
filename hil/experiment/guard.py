"""Checks every sample and stops the arm when a limit is exceeded or a reply is inconsistent.

The checks take a few us per sample. The per-joint checks form one compiled loop (`joint_checks`), which also applies
`following` (does the motor carry the commanded current), `consistency` (do position and velocity agree) and `work`
(does the motor turn as commanded). Other modules check the status registers (`status_check`) and the time without
commands or replies (`deadlines` and `silence`); `command_limits` clamps what is sent.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import copysign, inf, isnan
from typing import NoReturn

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.others.read_back import LOST_GOALS, LOST_OF
from hil.drivers.packet import ALERT, StatusError
from hil.drivers.servo import describe_status_error
from hil.drivers.servo_model import HARDLY_ANY, Mode
from hil.drivers.state import Slow, State, Status
from hil.errors import Cause, SafetyStop
from hil.experiment import following, joint_checks, work
from hil.experiment.apart import Apart
from hil.experiment.command_limits import CommandLimits
from hil.experiment.deadlines import Deadlines
from hil.experiment.following import CurrentNoise
from hil.experiment.joint_checks import JOINT, MOST_OUTSIDE_RAD, JointChecks
from hil.experiment.silence import LATE_WAKE_UP_S, Silence
from hil.experiment.status_check import StatusCheck
from hil.plan.find_torque import how_to_find_torque
from hil.plan.recent_motion import RecentMotion

__all__ = ["MOST_OUTSIDE_RAD", "Guard"]

JUMP_FACTOR = 1.5
"""Ratio of the distance that a joint may appear to move between two samples to the distance its velocity limit allows.
"""

EARLY_MOTION_RAD = 0.05
"""Largest motion allowed while the arm rests before the start [rad]."""

BELOW_VOLTAGE = 0.9
"""If the supply cannot drive the commanded current at some speed, this fraction of that speed is proposed as a
limit.
"""

_LACKS_S, _EXPLAINED = 0.1, 0.5
"""The supply explains missing torque if, within the last `_LACKS_S` [s], it caused at least this fraction of it."""

_ERRORS_IN_A_ROW = 3
"""If this many consecutive replies of a servo contain both values and an error number, the arm is stopped: the servo
may be rejecting its goals.
"""

NONE_HEARD = "No servo was heard"
"""Beginning of the message if the arm is stopped because no servo replies."""


class Guard:
    """Compares each sample with the limits of the configuration. `look` raises SafetyStop.

    planned: largest planned goal of each joint [A, or V under PWM]; by default, from the configuration.

    interval: time between two exchanges [s]; by default, that between two samples. patience: how long an exchange waits
    for missing replies [s].

    heard_instead: returns a message about what arrived instead of replies, with advice; "" if nothing did.

    left_by_a_run: whether the arm is where an immediately preceding run left it. If that run was stopped at a limit, a
    joint may have come to rest slightly beyond it: such a joint may move back in, but no farther out.

    recent: the exchanges so far, if another guard has checked them.

    lowers_since: for an arm that is being lowered, the time of the last exchange that all servos answered [s]. Replies
    may then be missing for longer; temperatures, voltages and alerts are accepted as long as the servos have their
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
        currents = (joint.drive_mode is Mode.CURRENT for joint in config.joints)
        self._constants = [joint.torque_per_goal for joint in config.joints]
        self._units = [joint.drive_mode.goal_unit for joint in config.joints]
        self._models = [
            joint.joint.servo if by_current else None for joint, by_current in zip(config.joints, currents, strict=True)
        ]
        # A pilot lowers the torque itself after such a stop.
        self._is_lowering = is_lowering = lowers_since is not None
        lower = (
            ""
            if config.experiment.pilot or is_lowering
            else f" Lower experiment.peak_torque. {how_to_find_torque(config)}"
        )
        self._lower_torque = lower
        commands = CommandLimits(config)
        self.clamp = commands.clamp
        """Clamp goals to each joint's limit and slew rate [A or V]. Raises SafetyStop for a goal that is not finite."""
        self.holding = commands.holding
        """Set the goals now in effect [A or V], from which `clamp` continues."""
        self._config, self._planned = config, planned or _planned(config)
        self._interval = interval = 1.0 / rate if interval is None else interval
        self.recent = RecentMotion(config, interval) if recent is None else recent
        """The latest exchanges, including those during a stop."""
        self._silence = Silence(config, interval, patience, lowers_since)
        self._patience = patience or float("inf")
        self._late_after = self._patience + LATE_WAKE_UP_S
        """Duration above which an exchange shows that this computer is busy [s]."""
        self._heard_instead = heard_instead
        self._deadlines = Deadlines(config, heard_instead, any_share=is_lowering)
        self._longest_gap = safety.watchdog
        self._joints = _joint_records(config, self._planned, left_by_a_run)
        self._noise = CurrentNoise(config.joints)
        self.current_noise = [0.0] * len(config.joints) if noise is None else noise
        """Noise of each joint's current readings, or its upper bound [A or V]; 0 if not known."""
        self._allow(self.current_noise)
        self._checks = JointChecks(self._joints, interval)
        self._apart = Apart()
        self._status = StatusCheck(config, heard_instead, bears_errors=is_lowering)
        self._missing = self._silence.counts
        self._errors = [0] * len(config.joints)
        """Number of consecutive replies that contained both values and an error number, by joint."""
        self._was_irregular = False
        """Whether replies were missing or reported an error in the previous exchange."""
        self._resting: Sequence[float] | None = None
        self._shortest = float("inf")
        self._supply = [float("nan")] * len(config.joints)
        """Lowest measured supply voltage of each joint [V]; NaN before the first reading."""

    def woke_up(self, now: float, late: float) -> None:
        """Record that this program woke up at `now` [s], `late` [s] after the intended time (negative: earlier)."""
        self._silence.woke_up(now, late)

    def others_answer(self) -> None:
        """Record that some servos that are not heard do answer: a silent one hides their replies."""
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
        if gap >= self._longest_gap:
            self._deadlines.check_gap(gap)
        if took >= self._late_after:
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
                self._stop_for(fault, state)
            self._silence.all_heard(now)
        if apart is not None and (turned := self._apart.look(apart)) is not None:
            self._not_together(*turned)
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
        """Check an exchange with missing replies or with errors in replies, or one that follows such an exchange."""
        now, missing, error = state.time_before_write, state.missing, state.error
        self._silence.ask(now)
        # While the arm is lowered, an exchange may be awaited for a good part of the time that is allowed.
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
                self._stop_for(fault, state)
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
        self._stop(
            index,
            Cause.GOALS_LOST,
            f"does not accept goals: {held}, and it missed {LOST_GOALS} of the last {LOST_OF} goals. "
            f"{self._status.why_lost()}",
        )

    def _stop_for(self, fault: int, state: State) -> NoReturn:
        """Raise SafetyStop for a fault found by the joint checks."""
        index, check = divmod(fault, joint_checks.CHECKS)
        said = (
            self._jumped,
            self._outside,
            self._too_fast,
            self._not_followed,
            self._disagree,
            self._turns_the_wrong_way,
            self._frozen,
        )
        said[check](index, state)

    def rests_at(self, positions: Sequence[float]) -> None:
        """Set the joints' angles before torque was switched on [rad]; by default, those of the first sample are
        used. From now on, `measure_noise` is called with each exchange until `noise_is_known`.
        """
        self._resting = positions
        self._joints["following"]["allowed"] = inf  # until some readings have shown their noise

    def measure_noise(self, state: State) -> None:
        """Process an exchange of an arm at rest: until its noise is known, a current reading may deviate."""
        if self._noise.add(state):
            self._allow(self._noise.measured()[1])

    def noise_is_known(self) -> list[str]:
        """End the measurement of noise; return what it means for each joint whose current reading is noisy.

        Raises SafetyStop if a reading is too noisy for a check of the current.
        """
        noise, most = self._noise.measured()
        self.current_noise = most
        self._allow(most)
        noisy = []
        for index, joint in enumerate(self._config.joints):
            usual = following.usual_sigma(joint, self._planned[index])
            if not self._joints[index]["is_followed"] or most[index] <= usual:
                continue
            said = self._how_noisy(index, noise[index])
            if noise[index] > following.MOST_NOISE * joint.goal_limit:
                remedy = "Check its supply and its cable; replace the servo if this happens again."
                self._stop(index, Cause.NOT_FOLLOWING, f"cannot be monitored: {said}. {remedy}")
            noisy.append(f"{self._names[index]}: {said}")
        return noisy

    def _allow(self, noise: Sequence[float]) -> None:
        share = self._safety.follow_share
        each = zip(self._joints, self._config.joints, self._planned, noise, strict=True)
        for record, joint, planned, sigma in each:
            following.allow_noise(record["following"], record["goals"], joint, planned, share, sigma)

    def _how_noisy(self, index: int, noise: float) -> str:
        seen, unit = following.seen_above(self._joints[index]["following"], self._interval), self._units[index]
        return (
            f"its current reading is noisy: {noise:.2g} {unit} RMS at a constant goal; lost torque cannot be seen "
            f"within 0.1 s at goals below {seen:.2g} {unit}"
        )

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

    def _else_moved(self, velocity: float) -> str:
        """Return what may have moved a joint before the start if it is not swinging; velocity: its velocity [rad/s]."""
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
            return "If it is still swinging, as an arm with little friction does, wait until it is at rest."
        longer = f"raise safety.rest_time ({self._safety.rest_time:g} s)"
        return f"If it is still swinging after the previous run, as an arm with little friction does, {longer}."

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
        joint = self._joints[index]
        if self._missing[index] == 0 and isnan(joint["position"]):
            joint["seen_at"] = now
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
                f"answers with an error ({describe_status_error(error)}) instead of its state; its last state was "
                f"{too_long}. It refuses reads: power-cycle it.",
            )
        self._stop(
            index,
            Cause.MISSING,
            f"missed {self._missing[index]} replies in a row; its last reply was {too_long}. {self._silence_remedy()}",
        )

    def _silence_remedy(self) -> str:
        if heard := self._heard_instead():
            return heard
        if len(self._missing) == 1 or not all(self._missing):
            return "Requests or replies are lost: check its cable and its supply."
        # A servo that is silent also hides those that would answer after it; torque off shows which ones do.
        shared = f"{NONE_HEARD}; requests or replies are lost: check the adapter, the cables and the supply"
        if self._silence.is_busy:
            return f"{shared}, and whether other programs keep this computer busy: this program was running late."
        return f"{shared}."

    def _jumped(self, index: int, _: State) -> NoReturn:
        joint = self._joints[index]
        self._stop(
            index,
            Cause.JUMP,
            f"reports an angle that changed by {joint['moved']:+.3f} rad within {1e3 * joint['seconds']:.0f} ms; its "
            f"velocity limit allows at most {joint['most']:.3f} rad. Check the encoder, its magnet and the supply, "
            "and whether its horn slips.",
        )

    def _outside(self, index: int, state: State) -> NoReturn:
        joint = self._joints[index]
        self._stop(
            index,
            Cause.POSITION,
            f"is at {state.position[index]:.3f} rad, outside its position limit [{joint['low']:g}, {joint['high']:g}]."
            f"{self._lower_torque}",
        )

    def _too_fast(self, index: int, state: State) -> NoReturn:
        velocity = state.velocity[index]
        if self.recent.contradicts(index, velocity):
            self._stop(index, Cause.FROZEN, self._not_its_velocity(index, velocity))
        self._stop(
            index,
            Cause.VELOCITY,
            f"is moving at {state.velocity[index]:.2f} rad/s, more than its velocity limit of "
            f"{self._joints[index]['fastest']:g} rad/s.{self._lower_torque}",
        )

    def _not_its_velocity(self, index: int, velocity: float) -> str:
        said, reach = f"reports a velocity of {velocity:+.2f} rad/s", "that no servo of this model can reach"
        slips = ""
        if travels := self.recent.travels(index):
            moved, seconds, *_ = travels[0]
            way = f"which changed by {moved:+.4f} rad in the last {1e3 * seconds:.0f} ms"
            said += f" that contradicts its position, {way}"
            if self.recent.is_unreachable(index, velocity):
                said += f", and {reach}"
            else:
                slips = ", or its horn has just begun to slip"
        else:
            said += f" {reach}"
        return (
            f"{said}: this reading is wrong{slips}. Check the servo and whether a device between adapter and servo "
            "changes its replies; replace the servo if it happens again."
        )

    def _not_followed(self, index: int, state: State) -> NoReturn:
        carried, commanded, velocity = state.current[index], state.goal_current[index], state.velocity[index]
        model, unit = self._models[index], self._units[index]
        said = f"carries {carried:.3f} {unit} instead of the commanded {commanded:.3f} {unit}"
        # If the servo holds another goal, that explains its current.
        has_own_goal = self._status.other_goal(index) is None
        if has_own_goal and model and model.is_out_of_voltage(commanded, carried, velocity):
            if model.is_out_of_voltage(commanded, carried, velocity, self._supply[index]):
                self._out_of_voltage(index, commanded, carried, velocity)
            # Published figures are too uncertain to rule the supply out: the arm is braked all the same.
            self._stop(
                index,
                Cause.GOALS_CHANGED,
                f"{said} at {velocity:.2f} rad/s: {self._supply[index]:.1f} V would drive the commanded current at "
                "that speed, according to the published figures. Its goals are being altered in transit or by another "
                "program, its supply sags, "
                "or its current sensor is wrong: check these. If all are in order, its motor is weaker than published: "
                f"lower velocity_limit to {BELOW_VOLTAGE * abs(velocity):.2g} rad/s.",
            )
        seconds = self._joints[index]["found"]
        self._stop(
            index,
            Cause.NOT_FOLLOWING,
            f"{said}, according to the readings of the last {1e3 * seconds:.0f} ms. "
            f"{self._why_not_followed(index, state)}",
        )

    def _frozen(self, index: int, state: State) -> NoReturn:
        goals, unit = self._joints[index]["goals"], self._units[index]
        self._stop(
            index,
            Cause.NOT_FOLLOWING,
            f"has reported exactly the same position, velocity and current ({state.current[index]:.3f} {unit}) for "
            f"{1e3 * goals['same_for']:.0f} ms, although its goal has changed by more than {goals['most']:.3f} {unit}: "
            "its readings are frozen, its torque is off, or its goals do not arrive. Check the servo, and whether a "
            "device between adapter and servo repeats its replies.",
        )

    def _out_of_voltage(self, index: int, goal: float, carried: float, velocity: float) -> NoReturn:
        unit = self._units[index]
        self._stop(
            index,
            Cause.OUT_OF_VOLTAGE,
            f"carries {carried:.3f} {unit} instead of the commanded {goal:.3f} {unit} at {velocity:.2f} rad/s: at that "
            "speed its supply cannot drive more current against the back-EMF, or its current sensor is wrong. Lower "
            f"velocity_limit to {BELOW_VOLTAGE * abs(velocity):.2g} rad/s, or raise the supply voltage; if this "
            f"happens at lower speeds too, suspect the sensor.{self._lower_torque}",
        )

    def look_at_supply(self, index: int, lacking: float, recent: Sequence[State]) -> None:
        """Raise SafetyStop if the measured current shows that the supply explains a joint's missing torque [N m]."""
        model = self._models[index]
        if model is None or not self._joints[index]["is_followed"] or self._status.other_goal(index) is not None:
            return
        for before, state in pairwise(recent):
            # What was sent with one sample acts until the next.
            goal, carried, velocity = before.goal_current[index], state.current[index], state.velocity[index]
            explained = self._constants[index] * (goal - carried) * copysign(1.0, lacking)
            if (
                state.time_before_write >= recent[-1].time_before_write - _LACKS_S
                and explained >= _EXPLAINED * abs(lacking)
                and model.is_out_of_voltage(goal, carried, velocity, self._supply[index])
            ):
                self._out_of_voltage(index, goal, carried, velocity)

    def _why_not_followed(self, index: int, state: State) -> str:
        carried, commanded, unit = state.current[index], state.goal_current[index], self._units[index]
        held = self._status.other_goal(index)
        if held is not None and abs(carried - held) < abs(carried - commanded):
            return (
                f"Its goal register reads {held:.3f} {unit}, which matches what it carries: another program is "
                "commanding it, or goals are being altered or lost in transit."
            )
        along = carried if commanded == 0.0 else carried * copysign(1.0, commanded)
        allowed = self._joints[index]["following"]["allowed"]
        if along > abs(commanded) + allowed or along < -allowed:
            return "Its torque is not as commanded: another program is commanding it, or its current sensor is wrong."
        weak = "it cannot deliver this much at its speed and supply voltage (safety.follow_share)."
        if along > HARDLY_ANY * abs(commanded):
            return (
                f"Its goals are being altered in transit or by another program, its current sensor is wrong, or {weak}"
            )
        return f"Its torque is off, it was rebooted, its watchdog acted, or {weak}"

    def _not_together(self, index: int, servo: int, turned: float) -> NoReturn:
        ids = self._seconds[index]
        self._stop(
            index,
            Cause.APART,
            f"has servos that no longer turn together: ID {ids[servo]} has turned {turned:+.3f} rad relative to the "
            "first one since the start. Its horn slips, a screw is loose, one of the encoders is wrong, or its "
            "direction setting is wrong.",
        )

    def _disagree(self, index: int, state: State) -> NoReturn:
        self._stop(
            index,
            Cause.FROZEN,
            f"reports a velocity of {state.velocity[index]:+.2f} rad/s that does not fit its position, "
            f"{state.position[index]:.3f} rad: one of the two readings is frozen or wrong, or the horn slips. Check "
            "the horn, the encoder and its magnet; replace the servo if necessary.",
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

    def _turns_the_wrong_way(self, index: int, _: State) -> NoReturn:
        self._stop(
            index,
            Cause.WRONG_SIGN,
            f"is moving against its command: its motor has taken {self._joints[index]['found']:.2f} J out of the arm, "
            "more than friction can account for. Is its direction reversed, or is something else driving the arm?",
        )

    def _look_slow(self, slow: Slow) -> None:
        safety = self._safety
        if self._is_lowering:
            return  # the servos protect themselves, and holding on for seconds is better than dropping the arm
        for index, (celsius, volt) in enumerate(zip(slow.temperature, slow.voltage, strict=True)):
            if volt > 0.0 and not volt >= self._supply[index]:
                self._supply[index] = volt
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
        name = self._names[index]
        raise SafetyStop(f"{name[0].upper()}{name[1:]} {what}", cause)


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
    """Whether the servo reports the supply current, not the motor current; then only motion and status are checked."""
    return joint.drive_mode is Mode.CURRENT and joint.joint.servo.senses_supply


def _planned(config: Config) -> list[float]:
    """Largest configured goals [A or V]; the current limits if no torque is configured."""
    peaks = config.experiment.peak_torque
    if peaks is None:
        return [joint.goal_limit for joint in config.joints]
    return [peak / joint.torque_per_goal for joint, peak in zip(config.joints, peaks, strict=True)]
