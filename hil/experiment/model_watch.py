"""Check during the experiment that the motion is consistent with some arm of the dry run's ensemble.

The prior knowledge is the same as in the dry run: an ensemble of arms from `[arm.prior]` or from an earlier result. Its
mean and inflated covariance initialise `hil.estimator.models.momentum_observer`. Without link lengths, no dry run is
possible, and only the planned torque is known: the first motion then trains the model, and only later motion is judged.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np

from hil.config.experiment import ExperimentConfig
from hil.config.schema import Config
from hil.drivers.servo_prior import servo_prior
from hil.drivers.state import State
from hil.dry_run.ensemble import Ensemble, prior_ensemble
from hil.errors import Cause, SafetyStop
from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, inner, only_version
from hil.estimator.models.momentum_observer import NAMES, MomentumObserver, observe
from hil.estimator.models.parameters import CONSTANTS
from hil.estimator.models.standstill import WITHIN_RAD
from hil.experiment.checks.apart import causes_of_standstill
from hil.experiment.checks.consistency import check_standstill

UNLIKE_ANY_ARM = "does not move like any arm"

ARMS = 64
WIDENED = 1.5
"""Factor by which the ensemble's standard deviations are enlarged, to allow for effects that its model does not
include.
"""

_OF_TWO = tuple(name for name in NAMES if name.endswith("_2") or name == "coupling")
_RELATIVE_STD = 0.1
_FRICTIONS, _FRICTIONS_UNDESCRIBED = 8.0, 3.0
"""Lower bounds on the torque from which alarm thresholds are derived, in multiples of the mean dry friction, with and
without a description of the arm. They keep friction of up to twice the expected value from raising an alarm. Without a
description, the friction of typical servos is assumed; the bound then matters only if the planned torque is barely
larger than that friction.
"""
_TILT_SHARE = 0.2  # standard deviation of gravity perpendicular to the assumed direction, relative to gravity
_FRICTION_SPREAD = 3.0
"""Factor applied to the spread of servo friction for an arm without a description, to allow for friction outside its
servos.
"""
_UNDESCRIBED = {"gravity": 10.0, "viscous": 1.0, "offset": 0.3, "tilt": 1.0}
_INERTIA = 0.3
"""Standard deviations for an arm without a description, as multiples of the planned torque in SI units.

Gravity may be ten times as large as a small first torque, which then moves the arm by a tenth of a radian. But viscous
friction and inertia cannot be several times as large as the planned torque, because the arm would then hardly move. For
an excitation slower than `_USUAL_HZ`, their values are raised in proportion: long, heavy arms are excited slowly.
"""
_USUAL_HZ = 0.7
"""An excitation counts as slow if the geometric mean of its lowest and highest frequencies is below this."""
_FLAT = 0.3
"""Standard deviation of gravity and tilt if the arm moves in a horizontal plane, in the units of `_INERTIA`."""
_NEAR_LIMIT = 0.05
"""Distance from a position limit, as a fraction of the range, within which an end stop is named as a possible cause."""
_STILL_RAD_S = 0.06
_STEP_S = 0.02
"""If a torque is held over several exchanges, a joint must appear stationary for this time [s] before it is checked."""

_LAG_S = 0.012
"""Time constant with which a torque step appears in the velocity [s], due to current loop and velocity filter."""
_VAGUE_S = 0.004
"""If an exchange takes longer than usual by more than this [s], the time of its measurement counts as unknown."""
JOLT_S, JOLT_BACK_S = 0.01, 0.08
"""Time within which a slipping joint's velocity changes, and time within which it changes back [s]; below about 40 Hz,
the latter is three sample intervals.
"""

JOLT_RAD_S, JOLT_TIMES = 1.2, 5.0
"""Smallest change of velocity in `JOLT_S` that counts as a jolt [rad/s], and its smallest ratio to the RMS of ordinary
changes.
"""

IMPACT_TIMES, IMPACT_S = 1.5, 10.0
"""Smallest ratio of a jolt to the largest earlier change of velocity that was not reversed soon afterwards, and the
time constant with which that earlier change is forgotten [s].
"""

PLAY_RAD, CURVED = 0.03, 0.2
"""The first value is the displacement that a gear may cause within a jolt [rad]: a few times the backlash in a servo's
data sheet, because an elastic gear bounces from one flank to the other. The second one allows for the curvature of
ordinary motion, as a fraction of the usual change of velocity times the duration.
"""

_USUAL_S = 1.0
_GAP = 3.0
"""Gap between two samples, in sample intervals, beyond which changes of velocity are not checked."""
_WINDOW_S = 0.3
"""Time span [s] for which a message about a stationary joint gives the torque range; a single value might be near 0."""


JOLT = np.dtype(
    [(name, "f8") for name in ("square", "age", "squared", "since", "change", "begun", "impact")]
    + [("count", "i8"), ("oldest", "i8"), ("reversed", "i8")]
)
"""Statistics of the changes of a joint's velocity; all are initially zero, except `begun`, which is minus infinity.

square, age: mean square of ordinary changes [rad^2/s^2], and the time that it covers [s]. squared, since: integral of
the squared changes that are not yet included because they may belong to a jolt, and the time that it covers [s].
change: first change of a possible jolt [rad/s]. begun: time of that change [s]. impact: largest change of velocity so
far that was not part of a jolt, decaying with time [rad/s]. count, oldest: number of earlier velocities stored, and the
row of the oldest. reversed: whether the joint reversed in the first change of a possible jolt.
"""


def _jolting(joints: Any, former: Any, velocity: Any, seconds: float, now: float, least: float, longest: float) -> int:
    """Process velocities [rad/s], `seconds` after the previous ones [s]; return a joint whose velocity jumped and
    jumped back a moment later, as when its horn slips; -1 if there is none.

    No motor can do this on any arm: it would have to accelerate and brake much harder than ever before. The check
    therefore needs no knowledge of the arm. Changes of velocity over `JOLT_S` are compared with ordinary ones.

    If the joint reverses in both changes, the motor has crossed the backlash of its gear twice in succession, which it
    does much faster than it can move the arm. This is not a jolt. In a gear with much backlash, a tooth that strikes
    the opposite flank changes the velocity even without a reversal. By chance, two such impacts may look like a jolt.
    Since single impacts are much more frequent, a change of velocity counts as a jolt only if it exceeds the largest of
    them.

    joints: records of type JOLT. former: the latest velocities (samples within `JOLT_S`, joints) [rad/s]. least:
    smallest change that counts as a jolt [rad/s]. longest: time within which the velocity jumps back [s].
    """
    back = former.shape[0]
    found = -1
    for index in range(len(joints)):
        joint = joints[index]
        row = joint.oldest
        change = velocity[index] - former[row, index]
        former[row, index] = velocity[index]
        joint.oldest = (row + 1) % back
        if joint.count < back:
            joint.count += 1
            continue
        joint.impact -= min(1.0, seconds / IMPACT_S) * joint.impact
        most = max(least, JOLT_TIMES * math.sqrt(joint.square), IMPACT_TIMES * joint.impact)
        is_jolt = not -most <= change <= most
        is_open = now - joint.begun <= longest
        turned_round = velocity[index] * (velocity[index] - change) < 0.0
        if is_jolt and is_open and change * joint.change < 0.0:
            if not (turned_round and joint.reversed):
                found = index if found < 0 else found
                continue
            is_open = False
        if is_jolt and not is_open:
            joint.impact = max(joint.impact, abs(joint.change) * math.exp((joint.begun - now) / IMPACT_S))
            joint.begun, joint.change, joint.reversed, is_open = now, change, turned_round, True
        # What may be the beginning of a jolt counts as ordinary motion only once no jolt has followed.
        joint.squared += seconds * min(change * change, most * most)
        joint.since += seconds
        if not is_open:
            joint.age += joint.since
            share = min(1.0, joint.since / min(joint.age, _USUAL_S))
            joint.square += share * (joint.squared / joint.since - joint.square)
            joint.squared = joint.since = 0.0
    return found


_jolting = inner(_jolting)


_TIMES = np.dtype(
    [(name, "f8") for name in ("seen_at", "shortest", "seconds", "vague", "longest_gap", "follows", "least", "jolts_s")]
)
"""Quantities that depend on the times of the samples.

seen_at, seconds: time of the latest sample, and time since the previous one [s]; seconds is infinite if the motion in
between is not judged. shortest: duration of the shortest exchange [s]. vague: the time of a measurement counts as known
if its exchange took at most this much longer than `shortest` [s]. longest_gap: largest `seconds` over which changes of
velocity are judged [s]. follows: fraction of a torque step that the motor has reached by the next sample. least:
smallest change of velocity that counts as a jolt [rad/s]. jolts_s: longest duration of a jolt [s].
"""

_DRIVE = np.dtype([(name, "f8") for name in ("constant", "goal", "felt")])
"""A joint's torque per goal [N m/A or N m/V], its latest goal [A or V] (NaN before the first one), and the torque that
its motor has reached [N m].
"""


def _watch_loop(
    times: Any,
    drives: Any,
    jolts: Any,
    velocities: Any,
    m: Any,
    rests: Any,
    past: Any,
    k: Any,
    before: float,
    after: float,
    q1: float,
    q2: float,
    v1: float,
    v2: float,
    goal_1: float,
    goal_2: float,
) -> int:
    """Process a sample: both checks in one call, since entering compiled code costs as much as a check itself.

    Returns _JOLTED times the number of the joint that jolted, plus the number of the joint whose motion is
    inconsistent. Both are counted from 1; a number is 0 if there is no such joint.

    velocities: the latest ones, as `_jolting` needs them. m, rests, past, k: the observer's arrays. before, after:
    times of the exchange [s].
    """
    at = times[0]
    seconds, at.seen_at = before - at.seen_at, before
    at.shortest = min(at.shortest, after - before)
    # During a long exchange the time of the measurement is unknown, so the motion up to it is not judged.
    is_known = not (np.isnan(drives[0].goal) or after - before - at.shortest > at.vague)
    at.seconds = seconds = seconds if is_known else np.inf
    for index in range(len(drives)):
        drive = drives[index]
        goal = goal_1 if index == 0 else goal_2
        torque = drive.constant * (drive.goal if is_known else goal)
        drive.felt = drive.felt + at.follows * (torque - drive.felt) if at.follows < 1.0 else torque
        drive.goal = goal
    if seconds > at.longest_gap:
        for index in range(len(jolts)):
            jolts[index].count = 0
    jolted = _jolting(jolts, velocities, (v1, v2), seconds, before, at.least, at.jolts_s)
    second = drives[1].felt if len(drives) > 1 else 0.0
    unlike = observe(m, rests, past, k, q1, q2, v1, v2, drives[0].felt, second, seconds)
    return int(_JOLTED * (jolted + 1) + unlike + 1)


def jolt_back_s(interval: float) -> float:
    """Return the time within which a slipping joint's velocity changes back [s]. interval: time between samples [s]."""
    return max(JOLT_BACK_S, 3.0 * interval)


Explain = Callable[[int, float, Sequence[State]], None]
_JOLTED = 4
_watch: Callable[..., int] = compiled(_watch_loop)


class ModelWatch:
    """Checks every sample against the model.

    planned: largest goal of each joint [A, or V in PWM mode]. arms: prior knowledge of the arm; by default, from the
    configuration. interval: time between two exchanges [s]; by default, the sample period. explain: called with a
    moving joint and its missing torque [N m]; raises SafetyStop if the latest samples explain it.
    """

    def __init__(
        self,
        config: Config,
        planned: Sequence[float],
        arms: Ensemble | None = None,
        interval: float | None = None,
        explain: Explain = lambda *_: None,
    ) -> None:
        self._explain = explain
        self._constants = [joint.torque_per_goal for joint in config.joints]
        largest = np.array([constant * goal for constant, goal in zip(self._constants, planned, strict=True)])
        mean, covariance = known_arm(config, largest, arms)
        interval = 1.0 / config.experiment.rate if interval is None else interval
        # A pilot's torque barely exceeds dry friction, whose behaviour near standstill is not modelled.
        is_described = arms is not None or config.arm.link_lengths is not None
        frictions = _FRICTIONS if is_described else _FRICTIONS_UNDESCRIBED
        self._observer = MomentumObserver(mean, covariance, largest, interval, frictions)
        self._names = [joint.joint.title for joint in config.joints]
        self._blocked_by = [causes_of_standstill(joint.joint) for joint in config.joints]
        self._limits = [joint.position_limit for joint in config.joints]
        # Goals held over several exchanges are steps, which the current and the velocity follow with a delay.
        self._is_held = interval < 0.99 / config.experiment.rate
        self._recent: deque[State] = deque(maxlen=math.ceil(_WINDOW_S / interval) + 1)
        self._stands_for = 0.0
        self._long = max(interval, _VAGUE_S)
        back = max(1, round(JOLT_S / interval))
        self._jolt_s = back * interval
        """Time over which a change of velocity is measured [s]."""
        self._jolts = np.zeros(len(largest), JOLT)
        self._jolts["begun"] = -np.inf
        self._times = np.zeros(1, _TIMES)
        self._times["shortest"] = np.inf
        self._times["vague"], self._times["longest_gap"] = self._long, _GAP * interval
        self._times["follows"] = 1.0 - math.exp(-interval / _LAG_S) if self._is_held else 1.0
        self._times["least"] = JOLT_RAD_S * max(1.0, interval / JOLT_S)
        self._times["jolts_s"] = jolt_back_s(interval)
        drives = np.zeros(len(largest), _DRIVE)
        drives["constant"], drives["goal"] = self._constants, np.nan
        velocities = np.zeros((back, len(largest)))
        self._memory = (self._times, drives, self._jolts, velocities, *self._observer.memory)
        _watch(*map(np.copy, self._memory), *(0.0,) * 8)  # compile
        self._watch: Callable[..., int] = only_version(_watch)

    def look(self, state: State) -> None:
        """Process the latest sample. Raises SafetyStop if no arm of the ensemble could have moved like this."""
        now, after, goal, _, velocity, position, _, missing, _, _, _ = state
        if True in missing:
            return
        if len(goal) == 1:
            position, velocity, goal = (*position, 0.0), (*velocity, 0.0), (*goal, 0.0)
        found = self._watch(*self._memory, now, after, *position, *velocity, *goal)
        if found:
            self._judge(*divmod(found, _JOLTED), state)
            return
        self._stands_for = 0.0
        self._recent.append(state)

    def _judge(self, jolted: int, unlike: int, state: State) -> None:
        """Decide whether to stop the arm. jolted: joint that jolted. unlike: joint whose motion is inconsistent. Both
        are numbered from 1; 0 means none.
        """
        if jolted:
            self._check_displacement(jolted - 1, state)
        self._recent.append(state)
        if not unlike:
            self._stands_for = 0.0
            return
        # After a step, a heavy joint takes a while to reach the smallest velocity that the register shows.
        if self._is_held and abs(state.velocity[unlike - 1]) < _STILL_RAD_S:
            self._stands_for += min(float(self._times["seconds"][0]), self._long)
            if self._stands_for < _STEP_S:
                return
        self._raise(unlike - 1, state)

    def _check_displacement(self, joint: int, state: State) -> None:
        """Raise SafetyStop for a jolt that moved the joint farther than gear backlash allows."""
        jolt = self._jolts[joint]
        began = float(jolt["begun"]) - self._jolt_s
        before = next((each for each in reversed(self._recent) if each.time_before_write < began + 1e-3), None)
        if before is not None:
            seconds = state.time_before_write - before.time_before_write
            expected = 0.5 * seconds * (before.velocity[joint] + state.velocity[joint])
            displaced = abs(state.position[joint] - before.position[joint] - expected)
            if displaced <= PLAY_RAD + CURVED * seconds * math.sqrt(float(jolt["square"])):
                return
        longest = float(self._times["jolts_s"][0])
        raise SafetyStop(
            f"{self._names[joint]} jerked: its velocity changed by {jolt['change']:+.1f} rad/s and back within "
            f"{1e3 * longest:.0f} ms, which the commanded torques cannot cause. Its horn slips on the shaft, its "
            "gear is worn, something hit it, its encoder is wrong, or another program sent it a goal.",
            Cause.UNEXPECTED,
        )

    def _raise(self, joint: int, state: State) -> NoReturn:
        lacking = self._observer.lacking[joint]
        name, velocity = self._names[joint], state.velocity[joint]
        check_standstill(name, reversed(self._recent), joint, _STILL_RAD_S)
        stands_for = standing_for(reversed(self._recent), joint)
        if abs(velocity) < _STILL_RAD_S and stands_for > 0.0:
            since, constant = state.time_before_write - min(stands_for, _WINDOW_S), self._constants[joint]
            # What was sent with one sample acts until the next.
            recent = [
                constant * before.goal_current[joint]
                for before, at in pairwise(self._recent)
                if at.time_before_write > since
            ]
            said = not_moving(name, recent, min(stands_for, _WINDOW_S)) + self._blocked_by[joint]
        else:
            self._explain(joint, lacking, self._recent)
            said = (
                f"{name} {UNLIKE_ANY_ARM} consistent with the prior and the data so far: "
                f"{lacking:+.3f} N m of the commanded torque is not reflected in its motion. Its motor or its "
                "encoder has failed, its horn slips, something is pushing or holding it, or the arm is not the one "
                "described."
            )
        raise SafetyStop(said + self._near_limit(joint, state.position[joint]), Cause.UNEXPECTED)

    def _near_limit(self, joint: int, angle: float) -> str:
        """Return a sentence if a joint may have hit an end stop; "" if it is far from its position limits."""
        low, high = self._limits[joint]
        limit = low if angle - low < high - angle else high
        if abs(angle - limit) > _NEAR_LIMIT * (high - low):
            return ""
        return f" It is at {angle:.2f} rad, close to its limit of {limit:g} rad: it may have hit an end stop there."


def standing_for(states: Iterable[State], joint: int) -> float:
    """Return for how long a joint's angle has hardly changed [s].

    states: the latest states, the most recent first.
    """
    last = first = next(iterator := iter(states))
    for state in iterator:
        if abs(state.position[joint] - last.position[joint]) > WITHIN_RAD:
            break
        first = state
    return last.time_before_write - first.time_before_write


def not_moving(name: str, torques: Sequence[float], seconds: float) -> str:
    """Report that a joint stood still for `seconds` [s] under `torques` [N m], which should have moved it."""
    low, high = min(torques), max(torques)
    return (
        f"{name} is not moving, with {low:+.3f} to {high:+.3f} N m commanded in the last {seconds:.2g} s: any arm "
        "consistent with the prior and the data so far would be moving. "
    )


def known_arm(config: Config, largest: Array, arms: Ensemble | None) -> tuple[dict[str, float], Array]:
    """Return the initial mean, by name, and the covariance of the momentum observer's parameters, in the order of
    NAMES.

    largest: largest planned torque of each joint (joints,) [N m]. arms: prior knowledge of the arm; by default, from
    the configuration.
    """
    if arms is None and config.arm.link_lengths is None:
        return _hardly_known(config, largest)
    arms = prior_ensemble(config, ARMS) if arms is None else arms
    joint = np.array([1 if name.endswith("_2") else 0 for name in NAMES])
    drawn = np.array(
        [[dict(zip(CONSTANTS, each.vector, strict=True)).get(name, 0.0) for name in NAMES] for each in arms.physics]
    )
    # Convert to units of the commanded torque, which adds the uncertainty of the torque constants.
    drawn = drawn / arms.torque_scale[:, np.minimum(joint, len(largest) - 1)]
    if len(largest) == 1:
        drawn[:, [name in _OF_TWO for name in NAMES]] = 0.0
    mean = drawn.mean(axis=0)
    covariance = WIDENED**2 * np.cov(drawn.T) + np.diag((_RELATIVE_STD * mean) ** 2)
    for number in (1, 2)[: len(largest)]:
        gravity, tilt, coulomb, offset = (
            NAMES.index(f"{name}_{number}") for name in ("gravity", "tilt", "coulomb", "offset")
        )
        covariance[tilt, tilt] += (_TILT_SHARE * mean[gravity]) ** 2
        covariance[offset, offset] += (0.5 * mean[coulomb]) ** 2
    return dict(zip(NAMES, mean.tolist(), strict=True)), np.asarray(covariance)


def _hardly_known(config: Config, largest: Array) -> tuple[dict[str, float], Array]:
    """Mean and covariance if only the planned torque and the servos' dry friction are known.

    To find out whether something holds a stationary joint, its friction must be bounded: otherwise, any torque might
    be too small to move it.
    """
    guesses = [servo_prior(joint.joint.servo).coulomb for joint in config.joints]
    mean = {f"coulomb_{number}": guess.median for number, guess in enumerate(guesses, 1)}
    spread = np.zeros(len(NAMES))
    is_flat, slowness = config.arm.gravity == 0.0, _slowness(config.experiment)
    for index, name in enumerate(NAMES):
        if len(largest) == 1 and name in _OF_TWO:
            continue
        joint = len(largest) - 1 if name.endswith("_2") else 0
        term = name.rpartition("_")[0]
        if term == "coulomb":
            spread[index] = _FRICTION_SPREAD * guesses[joint].spread * guesses[joint].median
        else:
            share = _FLAT if is_flat and term in ("gravity", "tilt") else _UNDESCRIBED.get(term, _INERTIA)
            share *= slowness if term not in ("gravity", "tilt", "offset") else 1.0
            spread[index] = share * largest[joint]
    return mean, np.diag(spread**2)


def _slowness(experiment: ExperimentConfig) -> float:
    """Return the factor by which the excitation is slower than usual; at least 1."""
    if experiment.band is not None:
        low, high = experiment.band
    else:
        harmonics = [line for lines in experiment.lines or [] for line in lines]
        low, high = min(harmonics) / experiment.period, max(harmonics) / experiment.period
    return max(1.0, _USUAL_HZ / math.sqrt(low * high))
