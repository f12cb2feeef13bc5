"""Detection of motor torques that differ from the torque column (clipped by the drive, timestamped by a different
clock, or delayed on one joint), and of mechanical stops that exert an additional torque.

As in the detection of reversed columns (`hil.estimator.baselines.signs`), the residual of inverse dynamics for the
torque as given is compared with that for a modified torque.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import InverseDynamics, MoreColumns, fit_inverse_dynamics
from hil.estimator.baselines.signs import COULOMB_WIDTH, CUTOFF, LESS_RESIDUAL
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError

BEYOND = np.array([0.7, 0.55, 0.4, 0.3, 0.2, 0.14, 0.1, 0.07, 0.04, 0.02])
"""Clipping levels to try, each given as the fraction of samples that exceed it."""
OUTERMOST = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4])
"""Angles at which to try a mechanical stop, each given as the fraction of samples beyond it."""
INTERVALS = np.arange(-4.0, 4.1)  # constant delays to try, in sampling intervals
DRIFTS = np.array([-16.0, -8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0, 16.0])  # total drifts to try
LATEST = 0.06  # s; largest delay to try between the torque of one joint and those of the others
FEWEST_STEPS = 2  # least difference between the best delays of two joints, in sampling intervals
UNEVEN = 0.85  # largest ratio of a joint's residual at its own best delay to that at the other joint's best delay
EXPLAINED = 0.3  # relative residual of each joint at its best delay, above which the torque does not fit at all
EVALUATIONS = 30  # maximum number of evaluations in the search for delay and drift
MOST_SAMPLES = 30_000  # more would take too long


@dataclass(frozen=True)
class Clipped:
    """A joint whose torque seems to be limited to `level` [N m], although the torque column exceeds this level in a
    fraction `beyond` of the samples.

    residual, residual_given: relative RMS of the joint's torque residual, with the limit and with the torque as given.
    """

    joint: int
    level: float
    beyond: float
    residual: float
    residual_given: float


@dataclass(frozen=True)
class Stop:
    """A yielding mechanical stop or object that a joint seems to press against beyond the angle `at` [rad].

    side: 1 if the joint touches it at larger angles, -1 if at smaller ones. stiffness: N m/rad.
    residual, residual_given: relative RMS of the joint's torque residual, with the stop and without it.
    """

    joint: int
    at: float
    side: int
    stiffness: float
    residual: float
    residual_given: float


@dataclass(frozen=True)
class ClockDrift:
    """A delay of the torque that changes steadily from `start` to `end` [s] during the longest recording.

    residual, residual_given: relative RMS of the worst joint's torque residual, with this drift and with the best
    constant delay.
    """

    start: float
    end: float
    relative: float
    """Change in the delay per unit of time: the relative difference between the clocks' rates."""
    residual: float
    residual_given: float


@dataclass(frozen=True)
class Late:
    """A joint whose torque column seems to be `delay` [s] later than those of the other joints; `delay` is negative if
    it is earlier.

    residual, residual_given: relative RMS of the worst joint's torque residual, with the column shifted by `delay` and
    with the column as given.
    """

    joint: int
    delay: float
    residual: float
    residual_given: float


@dataclass(frozen=True)
class Uneven:
    """Two joints whose motions are explained best by different delays of their torques.

    late, early: the joints (from 1) with the longest and the shortest delay. by: difference between these delays [s].
    residual, residual_given: relative RMS of one joint's torque residual, with its own best delay and with that of the
    other joint.
    """

    late: int
    early: int
    by: float
    residual: float
    residual_given: float


def suspect_clipped(recordings: Sequence[Recording]) -> tuple[Clipped, ...]:
    """Return the joints whose motion is explained much better by a limited torque than by the torque as given."""
    given = _residuals(recordings)
    if given is None:
        return ()
    found = []
    for joint in range(recordings[0].joints):
        size = np.abs(np.concatenate([each.torque[joint] for each in recordings]))
        tried = []
        for beyond in BEYOND.tolist():
            level = float(np.quantile(size, 1.0 - beyond))
            if level == 0.0:  # most commands are zero: clipping cannot cause that
                continue
            limit = np.where(np.arange(recordings[0].joints) == joint, level, np.inf)[:, None]
            left = _residuals([replace(each, torque=np.clip(each.torque, -limit, limit)) for each in recordings])
            if left is not None:
                tried.append(Clipped(joint + 1, level, beyond, float(left[joint]), float(given[joint])))
        best = min(tried, key=lambda each: each.residual, default=None)
        if best is not None and best.residual < LESS_RESIDUAL * best.residual_given:
            found.append(best)
    return tuple(found)


def suspect_stop(recordings: Sequence[Recording]) -> Stop | None:
    """Return the mechanical stop that explains the motion much better than springs or the torque alone; None if there
    is no such stop.
    """
    joints = recordings[0].joints
    given, sprung = _residuals(recordings), _residuals(recordings, _springs)
    if given is None or sprung is None:
        return None
    tried = []
    for joint in range(joints):
        angles = np.concatenate([each.filled()[joint] for each in recordings])
        for side, beyond in itertools.product((1, -1), OUTERMOST.tolist()):
            at = float(side * np.quantile(side * angles, 1.0 - beyond))
            fitted = _fitted(recordings, partial(_pressing, joint, at, side))
            if fitted is not None and fitted.value[-1] > 0.0:
                left = float(fitted.relative_residual[joint])
                tried.append(Stop(joint + 1, at, side, float(fitted.value[-1]), left, float(given[joint])))
    best = min(tried, key=lambda each: each.residual / each.residual_given, default=None)
    if best is None or best.residual > LESS_RESIDUAL * min(best.residual_given, float(sprung[best.joint - 1])):
        return None
    return best


def _pressing(joint: int, at: float, side: int, positions: Array) -> Array:
    """Return the regressor's column for a mechanical stop (joints, samples, 1)."""
    column = np.zeros((*positions.shape, 1))
    column[joint, :, 0] = side * np.maximum(side * (positions[joint] - at), 0.0)
    return column


def _springs(positions: Array) -> Array:
    """Return the regressor's columns for a spring on each joint (joints, samples, joints)."""
    return positions[:, :, None] * np.eye(len(positions))[:, None, :]


def suspect_late(recordings: Sequence[Recording]) -> Late | None:
    """Return a joint whose torque has its own delay if that explains the motion much better than a common delay."""
    joints = recordings[0].joints
    if joints < 2 or sum(each.time.size for each in recordings) > MOST_SAMPLES:
        return None
    unit = float(np.median([each.interval for each in recordings]))

    def left(delays: Array) -> float:
        found = _residuals([_delayed(each, delays) for each in recordings])
        return np.inf if found is None else float(found.max())

    common = min((left(np.full(joints, -unit * each)), each) for each in INTERVALS.tolist())
    most = max(1, min(24, round(LATEST / unit)))
    tried = [
        Late(joint + 1, unit * steps, left(np.where(np.arange(joints) == joint, -unit * steps, 0.0)), common[0])
        for joint in range(joints)
        for steps in (*range(-most, 0), *range(1, most + 1))
    ]
    best = min(tried, key=lambda each: each.residual)
    return best if best.residual < LESS_RESIDUAL * common[0] else None


def suspect_uneven(recordings: Sequence[Recording]) -> Uneven | None:
    """Return two joints whose torques have different best delays; None if there are no such joints.

    Each delay is determined from the joint's own residual.
    """
    joints = recordings[0].joints
    if joints < 2 or sum(each.time.size for each in recordings) > MOST_SAMPLES:
        return None
    unit = float(np.median([each.interval for each in recordings]))
    most = max(FEWEST_STEPS + 1, min(24, round(LATEST / unit)))
    rows = [
        _residuals([_delayed(each, np.full(joints, unit * steps)) for each in recordings])
        for steps in range(-most, most + 1)
    ]
    left = np.stack([np.full(joints, np.inf) if row is None else row for row in rows])
    best = np.argmin(left, axis=0)
    late, early = int(np.argmax(best)), int(np.argmin(best))
    if best[late] - best[early] < FEWEST_STEPS or best.min() == 0 or best.max() == 2 * most:
        return None
    pairs = [(float(left[best[i], i]), float(left[best[j], i])) for i, j in ((late, early), (early, late))]
    own, other = min(pairs, key=lambda each: each[0] / each[1])
    if not own < UNEVEN * other or left.min(axis=0).max() > EXPLAINED:
        return None
    return Uneven(late + 1, early + 1, unit * float(best[late] - best[early]), own, other)


def _delayed(recording: Recording, delays: Array) -> Recording:
    """Return the recording with each joint's torque delayed by `delays` (joints,) [s]."""
    time = recording.time
    rows = [np.interp(time - late, time, row) for late, row in zip(delays, recording.torque, strict=True)]
    return replace(recording, torque=np.stack(rows))


def suspect_drift(recordings: Sequence[Recording]) -> ClockDrift | None:
    """Return the drift of the torque's delay if it explains the motion much better than a constant delay, otherwise
    None.
    """
    from scipy.optimize import minimize

    if sum(each.time.size for each in recordings) > MOST_SAMPLES:
        return None
    unit = float(np.median([each.interval for each in recordings]))
    longest = max(float(each.time[-1] - each.time[0]) for each in recordings)

    def left(x: Array) -> float:
        delay, relative = unit * float(x[0]), unit * float(x[1]) / longest
        found = _residuals([_shifted(each, delay, relative) for each in recordings])
        return np.inf if found is None else float(found.max())

    constant = min(((left(np.array([each, 0.0])), each) for each in INTERVALS.tolist()), default=(np.inf, 0.0))
    drifting = min((left(np.array([constant[1], each])), each) for each in DRIFTS.tolist())
    if not drifting[0] < constant[0]:
        return None
    start = np.array([constant[1], drifting[1]])
    simplex = start + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5 * drifting[1]]])
    best = minimize(left, start, method="Nelder-Mead", options={"maxfev": EVALUATIONS, "initial_simplex": simplex})
    if not best.fun < LESS_RESIDUAL * constant[0] or abs(best.x[1]) < 1.0:
        return None
    middle, half = unit * float(best.x[0]), 0.5 * unit * float(best.x[1])
    return ClockDrift(middle - half, middle + half, 2.0 * half / longest, float(best.fun), constant[0])


def _shifted(recording: Recording, delay: float, relative: float) -> Recording:
    """Return the recording with a torque delay that is `delay` at mid-recording and grows at the rate `relative`."""
    time = recording.time
    at = time - delay - relative * (time - 0.5 * (time[0] + time[-1]))
    return replace(recording, torque=np.stack([np.interp(at, time, torque) for torque in recording.torque]))


def _residuals(recordings: Sequence[Recording], more: MoreColumns | None = None) -> Array | None:
    """Return the relative RMS of the torque residual (joints,); None if inverse dynamics cannot be solved."""
    fitted = _fitted(recordings, more)
    return None if fitted is None else fitted.relative_residual


def _fitted(recordings: Sequence[Recording], more: MoreColumns | None) -> InverseDynamics | None:
    try:
        return fit_inverse_dynamics(recordings, CUTOFF, COULOMB_WIDTH, more=more)
    except EstimationError:
        return None
