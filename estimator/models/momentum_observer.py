"""Sample-by-sample check, without accelerations, that an arm's motion is consistent with its model.

The planar arm's equations, integrated once, are linear in its parameters and contain only angles, velocities and
torques:

    torque = d/dt momentum(q, v) theta + remainder(q, v) theta

After a first-order low-pass filter both sides become sums over the past (generalised momentum: A. De Luca and R.
Mattone, "Sensorless robot collision detection and hybrid force/motion control", ICRA 2005; J.-J. Slotine and W. Li, "On
the adaptive control of robot manipulators", 1987). The parameters are given as the mean and covariance of an ensemble
of arms, and are updated with each sample (recursive least squares, that is, a Kalman filter on constants that drift
slowly). The range of admissible motion is therefore wide for a poorly known arm and narrows as the arm moves.

A joint's residual torque is the part of its torque that the motion does not account for. An alarm is raised if it
exceeds three thresholds for `HOLD_S` (or for a shorter time if it far exceeds them): `TIMES` standard deviations of the
uncertainty due to parameters and noise, the torque that friction can balance while the joint stands still, and a
fraction of the largest planned torque. The noise is estimated as well, so that effects that the model lacks (Stribeck
friction, backlash, flexibility) widen the admissible range. A deviation that could lead to an alarm is only included in
this estimate once it has subsided without causing an alarm. Otherwise, if something held a joint for a long time, the
range would widen until nothing exceeded it. For the same reason, the noise is bounded, so that a residual torque larger
than the largest planned torque always counts: a push that grows slowly would otherwise widen the range ahead of itself.
A lower noise level is assumed while a joint stands still, since most noise arises only in motion.

Once a joint's angle has stayed within its gear's play for `_STAYS_S`, the reported velocity does not show in which
direction friction acts: the motor may stick while the link floats from one side of the play to the other. In that case,
a torque that friction in either direction could balance does not contribute to an alarm.

The torque that friction can balance includes the viscous friction at the speeds of the usual motion: in a small motion,
where presliding of the gear softens every reversal, dry friction looks viscous but still holds the joint once it has
stopped.

While an arm is being learnt, its parameters adapt to a disturbance as if it were a property of the arm. Therefore
the mean torque over the last few tenths of a second is also compared with an earlier state of the model
(`earlier_model`).

Model errors, and the rounding of a velocity that stays below one tick, persist over many updates, so successive updates
are not independent. Therefore each one has only a fraction of the full weight.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, embedded
from hil.estimator.models import earlier_model, standstill

NAMES = (
    *("inertia_1", "coupling", "inertia_2", "armature_2", "gravity_1", "gravity_2"),
    *("viscous_1", "viscous_2", "coulomb_1", "coulomb_2", "offset_1", "offset_2", "tilt_1", "tilt_2"),
)
"""Names of the parameters. The tilts are the gravity torques of a tilted base that vary with the sines of the angles.
"""

FILTER_S = 0.02
HOLD_S = 0.05
"""Time for which the residual torque must exceed its thresholds [s]: longer than a gear takes to cross its backlash."""

TIMES = 4.0
FLOOR_SHARE = 0.25
"""A residual torque below this fraction of the largest planned torque never raises an alarm."""

_COUNT = len(NAMES)
_STANDING = 0.05  # rad/s below which dry friction may hold a joint
_PLAY_RAD = 0.006  # backlash of a gear (0.0044 in a data sheet) plus encoder noise
_STAYS_S = 0.03  # time within this play after which the direction of friction counts as unknown
_STATIC = 1.5  # ratio of static to Coulomb friction
_CERTAIN = 2.0  # standard deviations to subtract from an estimated torque so that the remainder certainly acts
_INERTIAS = 4  # number of inertial parameters, which come first
_SHOWN = 2.5  # acceleration above which inertias are learnt, in standard deviations of its rounding error
_VISIBLE = 2.0  # smallest velocity that shows in the register, in standard deviations of its rounding error
_VELOCITY_STD = 0.0135  # rad/s: rounding of the register, whose resolution is 0.024, and some noise
_FIRST_NOISE_SHARE = 0.1  # initial noise as a fraction of the largest planned torque
_NOISE_S = 1.0  # time constant of the noise estimate
_USUAL_S = 1.0  # time constant of the mean square velocity and of the memory of accelerations
_MOST_NOISE = 1.0 / (FLOOR_SHARE * TIMES)  # largest noise, relative to the highest floor (see below)
_CLIPPED = 9.0  # maximum influence of one sample on the noise estimate, in variances of the noise
_STANDING_NOISE = 0.3  # fraction of the noise, and of the smallest threshold, that remains while a joint stands still
_LESSONS = 2.0  # number of successive updates that share one model error
_STANDING_LESSONS = 28.0  # the same, for the rounding of velocities that stay below a tick while a joint hardly moves
_DRIFT, _LEAST_DRIFT = 0.03, 1e-3  # drift per second, relative to a parameter and its initial standard deviation
_MOST_WEIGHT = 6.0  # maximum weight of a sample whose residual torque far exceeds the threshold
_OBVIOUS = 3.0  # multiple of the threshold at which one sample is enough at low rates
_WARM_S = 3 * FILTER_S
_LONGEST_GAP = 3.0  # number of intervals between two samples after which the observer restarts

# Rows of the observer's memory: filtered momentum and remainder, remainder at the previous sample (two joints each),
# the parameters, a row of scalars, and the parameters' covariance.
_MOMENTUM, _REST, _FORMER, _THETA, _SINGLE, _COVARIANCE = 0, 2, 4, 6, 7, 8
_PENDING = _COVARIANCE + _COUNT
# They are followed by work space that would otherwise be allocated in every call: both joints' regressors, the row of a
# joint's equation, and the covariance times that row. Each regressor is zero in the same columns of every sample.
_OF_MOMENTUM = _PENDING + 1
_OF_REST, _ROW, _GAIN = _OF_MOMENTUM + 2, _OF_MOMENTUM + 4, _OF_MOMENTUM + 5
# Scalars: per joint filtered torque, noise variance, fraction of time at standstill, duration and sample count of a
# possible alarm, residual torque; then the time since the last parameter update and since the start.
_TORQUE, _NOISE, _STANDS, _HELD, _SAMPLES, _LACKING, _LESSON, _AGE = 0, 2, 4, 6, 8, 10, 12, 13
# Last row, per joint: contribution of a possible alarm to the noise estimate, and its duration; mean square velocity;
# square of the largest recent acceleration; an angle, and for how long the joint has stayed near it.
_TAUGHT, _TEACHES, _SQUARED, _SHARPEST, _ANGLE, _STAYS = 0, 2, 4, 6, 8, 10
# The constants: joints, interval, floors; from 4 drifts; then two minimum noises, the highest floors and their
# friction.
_HIGHEST = 4 + _COUNT + 2


class MomentumObserver:
    """Momentum observer for arms of one or two joints.

    mean: parameters by name; missing ones are 0.
    covariance: their covariance in the order of NAMES (14, 14).
    largest: largest planned torque of each joint (joints,) [N m].
    interval: time between two samples [s].
    frictions: multiple of the dry friction in `mean`; thresholds are derived from this torque if it exceeds `largest`,
    since friction near standstill differs from the model.
    """

    def __init__(
        self,
        mean: Mapping[str, float],
        covariance: Array,
        largest: Array,
        interval: float,
        frictions: float = 0.0,
    ) -> None:
        joints = len(largest)
        if joints not in (1, 2) or covariance.shape != (_COUNT, _COUNT):
            raise ValueError(
                f"{joints} joints and a covariance of shape {covariance.shape}: expected 1 or 2 joints and a shape of "
                "(14, 14)"
            )
        self._joints = joints
        self._memory = np.zeros((_GAIN + 1, _COUNT))
        self._memory[_THETA] = [mean.get(name, 0.0) for name in NAMES]
        self._memory[_COVARIANCE:_PENDING] = covariance
        expected = frictions * np.array([mean.get(f"coulomb_{number}", 0.0) for number in (1, 2)][:joints])
        first = np.maximum(largest, expected)
        self._memory[_SINGLE, _NOISE : _NOISE + joints] = (_FIRST_NOISE_SHARE * first) ** 2
        floor, highest = np.zeros(2), np.zeros(2)
        floor[:joints], highest[:joints] = FLOOR_SHARE * largest, FLOOR_SHARE * first
        self._rests = standstill.memory(joints, _COUNT)
        drift = _LEAST_DRIFT**2 * np.diag(covariance)
        least_noise = (_FIRST_NOISE_SHARE * 0.1 * highest) ** 2
        friction = [FLOOR_SHARE * frictions]
        further = (drift, least_noise, highest, friction)
        self._constants = np.concatenate(([joints, interval, *floor], *further))
        self._past = earlier_model.memory(_COUNT)
        self.memory = self._memory, self._rests, self._past, self._constants
        """The first arguments of the compiled loop `observe`; the sample follows them."""
        self.observe(
            (0.0,) * joints, (0.0,) * joints, (0.0,) * joints, math.inf
        )  # compiles the loop and initialises the memory

    def observe(self, position: Any, velocity: Any, torque: Any, seconds: float) -> int:
        """Process one sample; return the joint (from 0) whose motion is inconsistent, or -1 if there is none.

        position: angles [rad]. velocity: velocities [rad/s]. torque: torques commanded since the previous sample [N m].
        seconds: time since the previous sample [s].
        """
        if self._joints == 1:
            position, velocity, torque = (position[0], 0.0), (velocity[0], 0.0), (torque[0], 0.0)
        return int(observe(*self.memory, *position, *velocity, *torque, seconds))

    @property
    def lacking(self) -> list[float]:
        """Commanded torque minus the torque that explains the latest motion (joints,) [N m]."""
        return [float(value) for value in self._memory[_SINGLE, _LACKING : _LACKING + self._joints]]

    @property
    def parameters(self) -> dict[str, float]:
        """Current parameter estimates by name [SI]."""
        return dict(zip(NAMES, self._memory[_THETA].tolist(), strict=True))


def _regressors(momentum: Any, rest: Any, q1: float, q2: float, v1: float, v2: float) -> None:
    """Compute both joints' regressor rows; the columns are in the order of NAMES."""
    cos_2, sin_2 = math.cos(q2), math.sin(q2)
    both = v1 + v2
    momentum[0, 0] = v1
    momentum[0, 1] = cos_2 * (v1 + both)
    momentum[0, 2] = both
    momentum[1, 1] = cos_2 * v1
    momentum[1, 2] = both
    momentum[1, 3] = v2
    rest[1, 1] = sin_2 * v1 * both
    rest[0, 4] = math.cos(q1)
    rest[0, 5] = rest[1, 5] = math.cos(q1 + q2)
    rest[0, 12] = math.sin(q1)
    rest[0, 13] = rest[1, 13] = math.sin(q1 + q2)
    rest[0, 6] = v1
    rest[1, 7] = v2
    rest[0, 8] = math.tanh(v1 / _STANDING)
    rest[1, 9] = math.tanh(v2 / _STANDING)
    rest[0, 10] = rest[1, 11] = 1.0


# Compiled code takes its arguments by position; m is the observer's memory, k its constants, j a joint.
def _begin_anew(m: Any, momentum: Any, rest: Any, t1: float, t2: float) -> None:
    """Restart, because the motion since the previous sample is unknown."""
    single = m[_SINGLE]
    for j in range(2):
        for i in range(_COUNT):
            m[_MOMENTUM + j, i] = momentum[j, i]
            m[_REST + j, i] = m[_FORMER + j, i] = rest[j, i]
        single[_TORQUE + j] = t1 if j == 0 else t2
        single[_STANDS + j] = 1.0
        single[_HELD + j] = single[_SAMPLES + j] = 0.0
        m[_PENDING, _TAUGHT + j] = m[_PENDING, _TEACHES + j] = m[_PENDING, _STAYS + j] = 0.0
    single[_LESSON] = single[_AGE] = 0.0


def _filter(m: Any, j: int, momentum: Any, rest: Any, torque: float, fallen: float, slope: float, row: Any) -> None:
    """Low-pass filter one joint's signals; write the regressors of the filtered equation to `row`."""
    single = m[_SINGLE]
    for i in range(_COUNT):
        m[_MOMENTUM + j, i] += fallen * (momentum[j, i] - m[_MOMENTUM + j, i])
        m[_REST + j, i] += fallen * (0.5 * (rest[j, i] + m[_FORMER + j, i]) - m[_REST + j, i])
        m[_FORMER + j, i] = rest[j, i]
        row[i] = slope * (momentum[j, i] - m[_MOMENTUM + j, i]) + m[_REST + j, i]
    single[_TORQUE + j] += fallen * (torque - single[_TORQUE + j])
    single[_STANDS + j] += fallen * (1.0 - abs(rest[j, 8 + j]) - single[_STANDS + j])


def _lacks(m: Any, j: int, row: Any) -> tuple[float, float]:
    """Return the residual torque and the part of its variance that is due to the parameters."""
    lacking = m[_SINGLE, _TORQUE + j]
    left_open = 0.0
    for i in range(_COUNT):
        if row[i] != 0.0:
            lacking -= row[i] * m[_THETA, i]
            left_open += row[i] * _gain(m, i, row)
    return lacking, left_open


def _gain(m: Any, i: int, row: Any) -> float:
    gain = 0.0
    for n in range(_COUNT):
        gain += m[_COVARIANCE + i, n] * row[n]
    return gain


def _learn(m: Any, row: Any, gain: Any, lacking: float, spread: float, first: int) -> None:
    """Update the parameters from index `first` on, allowing for uncertainty in the others (Schmidt-Kalman filter)."""
    for i in range(_COUNT):
        gain[i] = _gain(m, i, row)
    for i in range(_COUNT):
        if i >= first:
            m[_THETA, i] += gain[i] * lacking / spread
        for n in range(_COUNT):
            if i >= first or n >= first:
                m[_COVARIANCE + i, n] -= gain[i] * gain[n] / spread


def _keep_dissipative(m: Any) -> None:
    """Replace negative friction with zero, and adjust the other parameters according to the covariance."""
    for i in range(6, 10):
        if m[_THETA, i] < 0.0 and m[_COVARIANCE + i, i] > 0.0:
            share = m[_THETA, i] / m[_COVARIANCE + i, i]
            for n in range(_COUNT):
                m[_THETA, n] -= share * m[_COVARIANCE + n, i]


def _static_friction(m: Any, rest: Any, j: int) -> float:
    """Return the largest torque that friction may balance at standstill [N m]."""
    dry = m[_THETA, 8 + j] + math.sqrt(max(m[_COVARIANCE + 8 + j, 8 + j], 0.0))
    viscous = m[_THETA, 6 + j] - math.sqrt(max(m[_COVARIANCE + 6 + j, 6 + j], 0.0))
    peak = math.sqrt(2.0 * m[_PENDING, _SQUARED + j])  # peak velocity, assuming a sine
    return float(max(_STATIC * (dry + max(viscous, 0.0) * peak), _withstood(rest)))


def _is_blocked(
    m: Any,
    rest: Any,
    j: int,
    distance: float,
    row: Any,
    held: float,
    floor: float,
    noise: float,
    rounding: float,
    dt: float,
) -> bool:
    """Return whether joint j stands still although its torque has varied by more than friction can balance.

    distance: result of `standstill.look`. held: torque that certainly acts on the joint now. floor: smallest tolerance.
    noise, rounding: variances of one sample's residual torque at standstill. All in SI units.
    """
    if distance == 0.0:
        return False
    friction = _static_friction(m, rest, j)
    variance = 2.0 * noise
    if abs(distance) > 2.0 * friction:  # otherwise it cannot matter and would only take time to compute
        variance += _variance(rest, distance, row, m[_COVARIANCE:_PENDING])
    tolerance = max(TIMES * math.sqrt(variance), floor)
    momentum = _VISIBLE * math.sqrt(rounding) * FILTER_S
    return bool(_blocked(rest, distance, held, friction, tolerance, momentum, FILTER_S, dt))


def _second_moment(m: Any, weight_1: float, coupling: float, weight_2: float, armature: float) -> float:
    """Return the mean square of a weighted sum of the inertial parameters, given their mean and covariance."""
    mean = variance = 0.0
    weights = (weight_1, coupling, weight_2, armature)
    for i in range(4):
        mean += weights[i] * m[_THETA, i]
        for n in range(4):
            variance += weights[i] * weights[n] * m[_COVARIANCE + i, n]
    return mean * mean + max(variance, 0.0)


def _of_rounding(m: Any, j: int, slope: float, cos_2: float) -> float:
    """Return the variance of the residual torque due to the rounding of both velocities to ticks.

    While the inertias are unknown, each is assumed to have its largest possible value.
    """
    across = _second_moment(m, 0.0, cos_2, 1.0, 0.0)
    own = _second_moment(m, 1.0, 2.0 * cos_2, 1.0, 0.0) if j == 0 else _second_moment(m, 0.0, 0.0, 1.0, 1.0)
    rounding = slope * _VELOCITY_STD
    return float(rounding * rounding * (own + across))


def _alarms(single: Any, j: int, share: float, dt: float) -> bool:
    """Return whether the residual torque has exceeded its threshold for long enough; a larger excess needs less time.

    share: residual torque relative to the threshold. dt: time since the previous sample [s].
    """
    if share <= 1.0:
        single[_HELD + j] = single[_SAMPLES + j] = 0.0
        return False
    single[_HELD + j] += dt * min(max(share - 0.5, 1.0), _MOST_WEIGHT)
    single[_SAMPLES + j] += 1.0
    # If samples are far apart, a sudden fault may show in only one of them.
    enough = single[_SAMPLES + j] >= 2.0 or (dt >= HOLD_S and share >= _OBVIOUS)
    return bool(single[_HELD + j] >= HOLD_S and enough)


def _teach_noise(m: Any, j: int, taught: float, most: float, dt: float, pending: bool) -> None:
    """Update the noise variance, up to `most`; while an alarm is possible, contributions are deferred."""
    for_later = m[_PENDING]
    if pending:
        for_later[_TAUGHT + j] += taught * dt
        for_later[_TEACHES + j] += dt
        return
    seconds = dt + for_later[_TEACHES + j]
    if seconds <= 0.0:
        return
    mean = (taught * dt + for_later[_TAUGHT + j]) / seconds
    noise = m[_SINGLE, _NOISE + j] + min(seconds / _NOISE_S, 1.0) * (mean - m[_SINGLE, _NOISE + j])
    m[_SINGLE, _NOISE + j] = min(noise, most)
    for_later[_TAUGHT + j] = for_later[_TEACHES + j] = 0.0


def _stays(m: Any, j: int, angle: float, velocity: float, dt: float) -> bool:
    """Process a sample; return whether the joint moves but has stayed within its gear's play for some time."""
    if abs(angle - m[_PENDING, _ANGLE + j]) > _PLAY_RAD:
        m[_PENDING, _ANGLE + j], m[_PENDING, _STAYS + j] = angle, 0.0
        return False
    m[_PENDING, _STAYS + j] += dt
    return bool(m[_PENDING, _STAYS + j] >= _STAYS_S and velocity != 0.0)


def _beyond_either(m: Any, j: int, row: Any, lacking: float, static: float) -> float:
    """Return the excess of a residual torque over static friction [N m], whichever way friction acts."""
    return float(max(abs(lacking + row[8 + j] * m[_THETA, 8 + j]) - static, 0.0))


def _remember_speed(m: Any, j: int, velocity: float, dt: float) -> None:
    """Update the mean square of the joint's velocity."""
    m[_PENDING, _SQUARED + j] += min(dt / _USUAL_S, 1.0) * (velocity * velocity - m[_PENDING, _SQUARED + j])


def _remember_acceleration(m: Any, j: int, row: Any, dt: float) -> None:
    """Update the square of the joint's largest recent acceleration."""
    largest = max(abs(row[0]), abs(row[3]))
    former = m[_PENDING, _SHARPEST + j]
    m[_PENDING, _SHARPEST + j] = max(largest * largest, former * (1.0 - min(dt / _USUAL_S, 1.0)))


def _accelerates(m: Any, j: int, slope: float) -> bool:
    """Return whether recent accelerations exceed the rounding of velocities.

    Otherwise, inertias are not learnt: errors of that size in the regressors would bias them towards zero and make all
    other estimates wrong and overconfident.
    """
    rounding = slope * _VELOCITY_STD
    return bool(m[_PENDING, _SHARPEST + j] >= (_SHOWN * rounding) ** 2)


def _floor(m: Any, k: Any, j: int) -> float:
    """Return the smallest torque that can raise an alarm, which is lower for joints with little friction."""
    dry = m[_THETA, 8 + j] + math.sqrt(max(m[_COVARIANCE + 8 + j, 8 + j], 0.0))
    return float(max(k[2 + j], min(k[_HIGHEST + j], k[_HIGHEST + 2] * dry)))


def _look_back(
    m: Any,
    past: Any,
    k: Any,
    j: int,
    row: Any,
    velocity: float,
    stands: float,
    friction: float,
    rounding: float,
    dt: float,
) -> float:
    """Process joint j's sample; return its mean residual torque if the earlier model has failed to explain the torque
    for long enough, otherwise 0.

    stands: filtered indicator of standstill. friction: static friction [N m]. rounding: variance of the residual.
    """
    single = m[_SINGLE]
    _add(past, j, single[_TORQUE + j], stands, velocity, row, dt)
    if single[_LESSON] == 0.0:  # this sample updates the model
        _describe(past, j, _COUNT, single[_NOISE + j], friction)
        floor, found = _floor(m, k, j), 0.0
        for back in _BACK:
            mean = _compare(past, j, back, _COUNT, floor, rounding, FILTER_S)
            found = mean if found == 0.0 else found
        _keep(past, j, found)
        if j == int(k[0]) - 1:
            _store(past, m[_THETA], m[_COVARIANCE:_PENDING])
    return float(_unexplained(past, j))


def _observe_loop(
    m: Any, rests: Any, past: Any, k: Any, q1: float, q2: float, v1: float, v2: float, t1: float, t2: float, dt: float
) -> int:
    momentum, rest, row = m[_OF_MOMENTUM:_OF_REST], m[_OF_REST:_ROW], m[_ROW]
    _regressors(momentum, rest, q1, q2, v1, v2)
    if dt > _LONGEST_GAP * k[1]:
        _begin_anew(m, momentum, rest, t1, t2)
        _forget_past(past)
        for j in range(int(k[0])):
            _forget(rests[j])
        return -1
    single = m[_SINGLE]
    fallen = 1.0 - math.exp(-dt / FILTER_S)
    slope = fallen / ((1.0 - fallen) * dt)  # factor from a value minus its filtered value to its filtered derivative
    single[_LESSON] += dt
    single[_AGE] += dt
    is_warm = single[_AGE] > _WARM_S
    # Filtered signals are correlated: new information is only available after the filter's time constant.
    lesson = is_warm and single[_LESSON] >= FILTER_S
    if lesson:
        for i in range(_COUNT):
            m[_COVARIANCE + i, i] += (k[4 + i] + (_DRIFT * m[_THETA, i]) ** 2) * single[_LESSON]
        single[_LESSON] = 0.0
    alarm = -1
    for j in range(int(k[0])):
        q, v = (q1, v1) if j == 0 else (q2, v2)
        _filter(m, j, momentum, rest, t1 if j == 0 else t2, fallen, slope, row)
        if not is_warm:
            continue
        _remember_speed(m, j, v, dt)
        _remember_acceleration(m, j, row, dt)
        lacking, left_open = _lacks(m, j, row)
        single[_LACKING + j] = lacking
        stands = min(max(single[_STANDS + j], 0.0), 1.0)
        static, rounding = _static_friction(m, rests[j], j), _of_rounding(m, j, slope, math.cos(q2))
        quiet = 1.0 - (1.0 - _STANDING_NOISE) * stands
        noise, floor = quiet * quiet * single[_NOISE + j], _floor(m, k, j)
        spread = left_open + rounding + noise
        beyond = max(abs(lacking) - stands * static, 0.0)
        most = max(TIMES * math.sqrt(spread), quiet * floor)
        is_clear = not _stays(m, j, q, v, dt) or _beyond_either(m, j, row, lacking, static) > most
        if _alarms(single, j, beyond / most, dt if is_clear else 0.0):
            alarm = j
        distance = _look_at_rest(rests[j], q, stands, single[_TORQUE + j], row, m[_THETA])
        held = abs(lacking) - _CERTAIN * math.sqrt(left_open)
        if _is_blocked(m, rests[j], j, distance, row, held, quiet * floor, noise, rounding, dt):
            alarm = j
        mean = _look_back(m, past, k, j, row, v, stands, static, rounding, dt)
        if mean != 0.0:
            single[_LACKING + j], alarm = mean, j
        taught = min(beyond * beyond - left_open - rounding, _CLIPPED * single[_NOISE + j])
        most_noise = (_MOST_NOISE * k[_HIGHEST + j]) ** 2
        _teach_noise(m, j, max(taught, k[4 + _COUNT + j]), most_noise, dt * (1.0 - stands), single[_SAMPLES + j] > 0.0)
        if lesson and beyond <= TIMES * math.sqrt(spread) and not _is_suspect(rests[j]):
            taught_by = _LESSONS * (spread - left_open) + _STANDING_LESSONS * (1.0 - quiet) * rounding
            first = 0 if _accelerates(m, j, slope) else _INERTIAS
            _learn(m, row, m[_GAIN], lacking, left_open + taught_by + (stands * static) ** 2, first)
            _keep_dissipative(m)
    return alarm


_inner = partial(embedded, _nrt=False)  # none of these functions allocates memory
_regressors, _begin_anew, _filter = map(_inner, (_regressors, _begin_anew, _filter))
_gain, _lacks, _learn = map(_inner, (_gain, _lacks, _learn))
_keep_dissipative = _inner(_keep_dissipative)
_withstood, _forget, _look_at_rest = standstill.withstood, standstill.forget, standstill.look
_variance, _blocked, _is_suspect = standstill.variance, standstill.blocked, standstill.is_suspect
_BACK, _compare, _describe = earlier_model.BACK, earlier_model.compare, earlier_model.describe
_add, _store, _forget_past = earlier_model.add, earlier_model.store, earlier_model.forget
_keep, _unexplained = earlier_model.keep, earlier_model.unexplained
_static_friction, _is_blocked = map(_inner, (_static_friction, _is_blocked))
_second_moment, _of_rounding = map(_inner, (_second_moment, _of_rounding))
_alarms, _teach_noise, _floor = map(_inner, (_alarms, _teach_noise, _floor))
_stays, _beyond_either = map(_inner, (_stays, _beyond_either))
_remember_speed, _remember_acceleration = map(_inner, (_remember_speed, _remember_acceleration))
_accelerates, _look_back = map(_inner, (_accelerates, _look_back))
observe: Callable[..., int] = compiled(_observe_loop, _nrt=False)
