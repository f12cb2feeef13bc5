"""Check at every sample whether the motion of a spatial arm is consistent with its known parameters.

Angles, velocities and commanded torques pass through the same first-order low-pass filter, which also yields
accelerations. The residual torque, `torque - Y(q, v, a) theta`, is compared with its uncertainty, which is due to the
parameters' covariance, rounding of the velocities, and noise that is estimated while the arm moves. The parameters are
updated as well (a Kalman filter for slowly drifting constants), so the tolerance narrows over time. As in
`hil.estimator.models.momentum_observer`, which planar arms use, the friction that can hold a joint at rest is
subtracted from the residual. After a reversal, so is the friction that may still act in the former direction, because
friction in gears reverses only gradually, over some milliradians. An alarm is raised if the remainder exceeds `TIMES`
standard deviations and a fraction of the largest planned torque for `HOLD_S`; large residuals raise it sooner.

The noise estimate is updated only during motion: the residual of a joint at rest would widen the tolerance until
nothing exceeded it. It is bounded, so that a residual larger than the largest planned torque always counts. A joint at
rest is also assessed by the range of torques on it (`hil.estimator.models.standstill`). A residual that could lead to
an alarm enters the noise estimate only once it has subsided without an alarm.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import places
from hil.estimator.chain.model.kernels import accelerate, move, place, regress, room
from hil.estimator.compiled import compiled
from hil.estimator.models import standstill

FILTER_S = 0.02
HOLD_S = 0.02
TIMES = 4.0
FLOOR_SHARE = 0.25
"""A residual below this fraction of the largest planned torque never raises an alarm."""

FIRST_NOISE_SHARE = 0.1
STANDING = 0.05  # rad/s: below this, dry friction may hold a joint
STATIC = 1.5  # ratio of static to Coulomb friction
YIELDS_RAD = 0.005  # rad: distance within which friction may approach its new value after a reversal (Dahl's model)
MOSTLY = 0.5  # filtered indicator of standstill above which a joint counts as standing still
STANDING_NOISE = 0.3  # fraction of the noise, and of the smallest threshold, that remains while a joint stands still
VISIBLE_RAD_S = 0.027  # smallest velocity that certainly shows in the velocity register
CERTAIN = 2.0  # standard deviations to subtract from an estimated torque so that the remainder certainly acts
VELOCITY_STD = 0.0135  # rad/s: resolution of the register, plus noise
NOISE_S = 1.0
CLIPPED = 9.0
DRIFT, LEAST_DRIFT = 0.03, 1e-3
MOST_WEIGHT = 4.0
WARM_S = 3 * FILTER_S
LONGEST_GAP = 3.0
# Rows of the observer's memory. Per joint: filtered angle, velocity and torque, acceleration, noise variance, filtered
# indicator of standstill (0 to 1), time and number of samples above the limit, residual torque, contribution of a
# possible alarm to the noise estimate and its duration, dry friction if it reverses gradually, relative to its value
# during motion (-1 to 1). The last row applies to the whole arm: time since the last update of the parameters, time
# since the start.
ANGLE, VELOCITY, TORQUE, SLOPE, NOISE, STANDS, HELD, SAMPLES, LACKING, TAUGHT, TEACHES, BENT, TIMES_OF_ALL = range(13)


class ChainObserver:
    """Detects motion that is inconsistent with the arm's parameters, and refines the parameters as the arm moves.

    mean: base parameters, then viscous friction, dry friction and offsets (base + 3 joints,) [SI].
    covariance: covariance of `mean`.
    largest: largest planned torque of each joint (joints,) [N m].
    interval: sampling interval [s].
    frictions: `largest` is raised to at least this multiple of the dry friction, as far as that friction is known.

    Raises ValueError for arrays of other shapes.
    """

    def __init__(
        self,
        base: BaseParameters,
        mean: Array,
        covariance: Array,
        largest: Array,
        interval: float,
        frictions: float = 0.0,
    ) -> None:
        n = base.chain.joints
        count = base.count + 3 * n
        if mean.shape != (count,) or covariance.shape != (count, count) or largest.shape != (n,):
            raise ValueError(
                f"mean, covariance and largest have the shapes {mean.shape}, {covariance.shape} and {largest.shape}; "
                f"they must be {(count,)}, {(count, count)} and {(n,)}"
            )
        self._theta, self._covariance = np.array(mean), np.array(covariance)
        self._memory = np.zeros((TIMES_OF_ALL + 1, max(n, 2)))
        self._rests = standstill.memory(n, count)
        dry = np.maximum(mean[base.count + n : base.count + 2 * n], 0.0)
        first = np.maximum(largest, frictions * dry)
        self._first = np.array((FIRST_NOISE_SHARE * first) ** 2)
        self._memory[NOISE, :n] = self._first
        drift = LEAST_DRIFT**2 * np.diag(covariance)
        # Motion in one direction only cannot separate dry friction from an offset, so the friction that may hold a
        # joint at rest is never assumed to be less than was expected.
        floors = FLOOR_SHARE * np.stack((largest, first)), FLOOR_SHARE * frictions
        self._constants = *floors, (0.01 * first) ** 2, drift, interval, dry
        self._chain = base.chain.arrays, places(n, base.columns), base.count
        self._work = room(n), np.zeros((n, base.count + 1)), np.zeros(count), np.zeros(count), np.zeros((n, 10))
        self._joints = n
        self._unsupported = np.zeros(n)
        nothing = np.zeros(n)
        self.observe(nothing, nothing, nothing, math.inf, False)  # these calls compile the loop; the last one resets it
        self.observe(nothing, nothing, nothing, interval, False)
        self.observe(nothing, nothing, nothing, math.inf, False)

    def observe(
        self, position: Any, velocity: Any, torque: Any, seconds: float, is_free: Any, support: Array | None = None
    ) -> int:
        """Process one sample; return the joint (from 0) whose motion is inconsistent, or -1 if there is none.

        Args:
            position: angles [rad].
            velocity: velocities [rad/s].
            torque: torques commanded since the previous sample [N m].
            seconds: time since the previous sample [s].
            is_free: whether the motion of each joint can be assessed; one value for all or one per joint.
            support: for each joint that may rest against an end stop, the direction in which the stop blocks motion
                (1 or -1), otherwise 0 (joints,); None if there is no such joint.
        """
        return _observe(
            *(self._memory, self._rests, self._theta, self._covariance, self._constants, self._chain, self._work),
            *(np.asarray(each, dtype=np.float64) for each in (position, velocity, torque)),
            *(seconds, np.broadcast_to(is_free, (self._joints,)).astype(np.bool_)),
            self._unsupported if support is None else support,
        )

    @property
    def lacking(self) -> list[float]:
        """Latest residual of each joint: commanded torque minus the torque that explains the motion (joints,) [N m]."""
        return [float(value) for value in self._memory[LACKING, : self._joints]]

    @property
    def torque(self) -> list[float]:
        """Commanded torque of each joint, filtered in the same way as `lacking` (joints,) [N m]."""
        return [float(value) for value in self._memory[TORQUE, : self._joints]]

    @property
    def is_beyond(self) -> list[bool]:
        """Whether the latest residual of each joint exceeds the normal range (joints,)."""
        return [bool(value > 0.0) for value in self._memory[SAMPLES, : self._joints]]

    @property
    def parameters(self) -> Array:
        """Current estimate of the parameters, in the order of `mean`."""
        return self._theta.copy()


def _observe_loop(  # noqa: PLR0912, PLR0915
    memory: Any,
    rests: Any,
    theta: Any,
    covariance: Any,
    constants: Any,
    chain: Any,
    work: Any,
    q: Any,
    v: Any,
    torque: Any,
    dt: float,
    is_free: Any,
    support: Any,
) -> int:
    floors, of_friction, least_noise, drift, interval, expected = constants
    arrays, column, base = chain
    rooms, Y, row, gain, _ = work
    n, count = q.size, theta.size
    if dt > LONGEST_GAP * interval:
        for j in range(n):
            memory[ANGLE, j], memory[VELOCITY, j], memory[TORQUE, j] = q[j], v[j], torque[j]
            memory[SLOPE, j] = memory[HELD, j] = memory[SAMPLES, j] = 0.0
            memory[TAUGHT, j] = memory[TEACHES, j] = memory[BENT, j] = 0.0
            _forget(rests[j])
            memory[STANDS, j] = 1.0
        memory[TIMES_OF_ALL, 0] = memory[TIMES_OF_ALL, 1] = 0.0
        return -1
    fallen = 1.0 - math.exp(-dt / FILTER_S)
    slope = fallen / ((1.0 - fallen) * dt)
    for j in range(n):
        memory[ANGLE, j] += fallen * (q[j] - memory[ANGLE, j])
        memory[VELOCITY, j] += fallen * (v[j] - memory[VELOCITY, j])
        memory[SLOPE, j] = slope * (v[j] - memory[VELOCITY, j])
        memory[TORQUE, j] += fallen * (torque[j] - memory[TORQUE, j])
        standing = 1.0 - abs(math.tanh(v[j] / STANDING))
        memory[STANDS, j] += fallen * (standing - memory[STANDS, j])
        way = memory[VELOCITY, j] * dt
        memory[BENT, j] += (1.0 - math.exp(-abs(way) / YIELDS_RAD)) * (math.copysign(1.0, way) - memory[BENT, j])
    memory[TIMES_OF_ALL, 0] += dt
    memory[TIMES_OF_ALL, 1] += dt
    supported = 0
    for j in range(n):
        if not is_free[j]:
            memory[HELD, j] = memory[SAMPLES, j] = memory[LACKING, j] = 0.0
            _forget(rests[j])
            supported += 1
    if supported == n:
        return -1
    if memory[TIMES_OF_ALL, 1] <= WARM_S:
        return -1
    lesson = memory[TIMES_OF_ALL, 0] >= FILTER_S
    if lesson:
        for i in range(count):
            covariance[i, i] += (drift[i] + (DRIFT * theta[i]) ** 2) * memory[TIMES_OF_ALL, 0]
        memory[TIMES_OF_ALL, 0] = 0.0
    rotation, translation, axis, gravity = arrays
    place(rotation, translation, axis, memory[ANGLE, :n], rooms[0], rooms[1])
    link, armature = np.zeros((n, 10)), np.zeros(n)
    move(link, armature, memory[VELOCITY, :n], rooms)
    accelerate(armature, gravity, memory[VELOCITY, :n], memory[SLOPE, :n], rooms)
    for j in range(n):
        for i in range(base):
            Y[j, i] = 0.0
    regress(column, memory[SLOPE, :n], rooms, Y)
    alarm = -1
    for j in range(n):
        if not is_free[j]:
            continue
        for i in range(count):
            row[i] = Y[j, i] if i < base else 0.0
        row[base + j] = memory[VELOCITY, j]
        bend = math.tanh(memory[VELOCITY, j] / STANDING)
        row[base + n + j] = bend
        row[base + 2 * n + j] = 1.0
        lacking, left_open = memory[TORQUE, j], 0.0
        for i in range(count):
            lacking -= row[i] * theta[i]
            total = 0.0
            for k in range(count):
                total += covariance[i, k] * row[k]
            gain[i] = total
            left_open += row[i] * total
        memory[LACKING, j] = lacking
        friction = base + n + j
        learnt = theta[friction] + math.sqrt(max(covariance[friction, friction], 0.0))
        dry = max(learnt, expected[j])
        floor = max(floors[0, j], min(floors[1, j], of_friction * learnt))
        static = max(STATIC * dry, _withstood(rests[j]))
        stands = min(max(memory[STANDS, j], 0.0), 1.0)
        late = dry * (memory[BENT, j] - bend)  # friction that still acts in the former direction
        holds = max(static * stands, abs(late) if late * lacking > 0.0 else 0.0)
        # Error of the acceleration due to the velocity's rounding, times the joint's own inertia.
        inertia = 0.0
        if memory[SLOPE, j] != 0.0:
            inertia = abs(_own_inertia(rooms, column, theta, base, j))
        rounding = (slope * VELOCITY_STD * inertia) ** 2
        quiet = 1.0 - (1.0 - STANDING_NOISE) * stands
        spread = left_open + rounding + quiet * quiet * memory[NOISE, j]
        beyond = max(abs(lacking) - holds, 0.0)
        if lacking * support[j] > 0.0:
            beyond = 0.0
        limit = TIMES * math.sqrt(spread)
        share = beyond / max(limit, quiet * floor)
        if share <= 1.0:
            memory[HELD, j] = memory[SAMPLES, j] = 0.0
        else:
            memory[HELD, j] += dt * min(share, MOST_WEIGHT)
            memory[SAMPLES, j] += 1.0
            if memory[HELD, j] >= HOLD_S and memory[SAMPLES, j] >= 2.0:
                alarm = j
        if support[j] != 0.0:
            _forget(rests[j])
            continue
        distance = _look_at_rest(rests[j], q[j], stands, memory[TORQUE, j], row, theta)
        if distance != 0.0:
            variance = 2.0 * quiet * quiet * memory[NOISE, j]
            if abs(distance) > 2.0 * static:  # otherwise it cannot matter and would only take time to compute
                variance += _variance(rests[j], distance, row, covariance)
            tolerance = max(TIMES * math.sqrt(variance), quiet * floor)
            momentum = VISIBLE_RAD_S * abs(_own_inertia(rooms, column, theta, base, j))
            held = abs(lacking) - CERTAIN * math.sqrt(left_open)
            if _blocked(rests[j], distance, held, static, tolerance, momentum, FILTER_S, dt):
                alarm = j
        taught = min(beyond * beyond, CLIPPED * spread) - left_open - rounding
        most_noise = (floors[1, j] / (FLOOR_SHARE * TIMES)) ** 2
        _teach_noise(memory, j, max(taught, least_noise[j]), most_noise, dt * (1.0 - stands))
        # Static friction balances any torque within its bounds while a joint stands still, so nothing can be learnt
        # then.
        if lesson and beyond <= limit and memory[STANDS, j] < MOSTLY and not _is_suspect(rests[j]):
            total = spread + holds * holds
            for i in range(count):
                theta[i] += gain[i] * lacking / total
                for k in range(count):
                    covariance[i, k] -= gain[i] * gain[k] / total
    return alarm


def _teach_noise_of(memory: Any, j: int, taught: float, most: float, dt: float) -> None:
    """Update the noise variance, up to `most`; the contribution of a possible alarm is held back until the alarm has
    ended.
    """
    memory[TAUGHT, j] += taught * dt
    memory[TEACHES, j] += dt
    if memory[SAMPLES, j] > 0.0 or memory[TEACHES, j] <= 0.0:
        return
    mean = memory[TAUGHT, j] / memory[TEACHES, j]
    noise = memory[NOISE, j] + min(memory[TEACHES, j] / NOISE_S, 1.0) * (mean - memory[NOISE, j])
    memory[NOISE, j] = min(noise, most)
    memory[TAUGHT, j] = memory[TEACHES, j] = 0.0


def _own_inertia_of(rooms: Any, column: Any, theta: Any, base: int, j: int) -> float:
    """Return the diagonal element of the mass matrix for joint j, from the base parameters."""
    frame, motion = rooms[0], rooms[1]
    n = frame.shape[0]
    s = motion[j, 0]
    total = 0.0
    for i in range(j, n):
        f = frame[i]
        px, py, pz = f[9], f[10], f[11]
        bx, by, bz = s[3] + s[1] * pz - s[2] * py, s[4] + s[2] * px - s[0] * pz, s[5] + s[0] * py - s[1] * px
        z0 = f[0] * s[0] + f[3] * s[1] + f[6] * s[2]
        z1 = f[1] * s[0] + f[4] * s[1] + f[7] * s[2]
        z2 = f[2] * s[0] + f[5] * s[1] + f[8] * s[2]
        b0 = f[0] * bx + f[3] * by + f[6] * bz
        b1 = f[1] * bx + f[4] * by + f[7] * bz
        b2 = f[2] * bx + f[5] * by + f[8] * bz
        at = column[i]
        total += _of(theta, at[0], base) * (b0 * b0 + b1 * b1 + b2 * b2)
        total += 2.0 * _of(theta, at[1], base) * (b1 * z2 - b2 * z1)
        total += 2.0 * _of(theta, at[2], base) * (b2 * z0 - b0 * z2)
        total += 2.0 * _of(theta, at[3], base) * (b0 * z1 - b1 * z0)
        total += z0 * z0 * _of(theta, at[4], base) + 2.0 * z0 * z1 * _of(theta, at[5], base)
        total += 2.0 * z0 * z2 * _of(theta, at[6], base) + z1 * z1 * _of(theta, at[7], base)
        total += 2.0 * z1 * z2 * _of(theta, at[8], base) + z2 * z2 * _of(theta, at[9], base)
        if i == j:
            total += _of(theta, at[10], base)
    return total


def _of_column(theta: Any, at: int, base: int) -> float:
    """Return the base parameter in column `at`, or zero if there is none."""
    value: float = theta[at] if at < base else 0.0
    return value


_of: Any = compiled(_of_column)
_own_inertia: Any = compiled(_own_inertia_of)
_teach_noise: Any = compiled(_teach_noise_of)
_withstood, _forget, _look_at_rest = standstill.withstood, standstill.forget, standstill.look
_variance, _blocked, _is_suspect = standstill.variance, standstill.blocked, standstill.is_suspect
_observe: Callable[..., int] = compiled(_observe_loop)
