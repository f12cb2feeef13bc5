"""Extended and unscented Kalman filters whose state includes the parameters: baselines whose only measurements are
positions.

State: angles, velocities, base parameters. Between samples the motion is integrated by Runge-Kutta steps under the mean
motor torque; the parameters are constant except for a little process noise; each sample corrects the whole state. EKF:
Gautier and Poignet, Control Engineering Practice 9 (2001) 1361, here with the Jacobian of the integrated step computed
by finite differences. UKF: Julier and Uhlmann, Proc. IEEE 92 (2004) 401, symmetric sigma points.

The filters are given every fair advantage: the same dynamics as the likelihood, an initial guess from filtered least
squares with a realistic spread, several passes over the recording, and noise levels that the caller can tune.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled
from hil.estimator.data.recording import Recording
from hil.estimator.errors import ConvergenceError
from hil.estimator.models.parameters import ABSENT, CONSTANTS
from hil.estimator.models.terms import base_names

PASSES = 3
LONGEST_STEP = 1.3e-3  # s
SPREAD = 0.1  # initial standard deviation, relative to the parameter; the UKF's sigma points lie 4 times as far out
LEAST_SPREAD = 0.02  # minimum of that deviation, relative to the largest parameter of the same kind
DIFFERENCE = 1e-6
# The twelve constants of the compiled arm; a one-joint arm uses five of them.
SLOTS = CONSTANTS[:12]
TORQUES = ("gravity", "coulomb", "offset")

Filter = Literal["ekf", "ukf"]


@dataclass(frozen=True)
class Filtered:
    """Result of the filter after the last sample."""

    names: tuple[str, ...]
    value: Array
    """Base parameters (parameters,) [SI]."""
    std: Array
    """Standard errors from the filter's own covariance (parameters,) [SI]."""


def fit_by_kalman(
    recording: Recording,
    start: Array,
    kind: Filter,
    coulomb_width: float,
    velocity_noise: float,
    delay: float = 0.0,
) -> Filtered:
    """Run the filter over `recording` PASSES times.

    start: initial base parameters (parameters,) [SI].
    kind: "ekf" or "ukf".
    coulomb_width: width of the smoothed Coulomb step [rad/s].
    velocity_noise: process noise that accounts for model errors [rad/s per sqrt(s)].
    delay: delay of the torque [s].
    Raises ConvergenceError if the filter diverges.
    """
    joints = recording.joints
    names = base_names(joints)
    dt = recording.interval
    position = recording.filled().T.copy()
    torque = recording.mean_torque(np.append(recording.time, recording.time[-1] + dt), delay).T
    substeps = int(np.ceil(dt / LONGEST_STEP))
    scale = _scales(names, start)
    slots = np.array([SLOTS.index(name) for name in names])
    fixed = np.array([ABSENT[name] for name in SLOTS])
    theta, spread = start / scale, SPREAD * np.maximum(np.abs(start) / scale, LEAST_SPREAD / SPREAD)
    intervals = np.append(np.diff(recording.time), dt)
    run = _ekf if kind == "ekf" else _ukf
    first = np.concatenate((position[0], (position[5] - position[0]) / (5.0 * dt)))
    for _ in range(PASSES):
        x = np.concatenate((first, theta))
        P = np.diag(np.concatenate((np.full(joints, 1e-4), np.full(joints, 1.0), spread**2)))
        noise = np.concatenate((np.zeros(joints), np.full(joints, velocity_noise**2), np.full(len(names), 1e-14)))
        padded = np.zeros((len(torque), 2))
        padded[:, :joints] = torque
        run(x, P, noise, recording.noise**2, position, padded, intervals, substeps, scale, slots, fixed, coulomb_width)
        if not np.all(np.isfinite(x)):
            raise ConvergenceError(
                f"the {kind.upper()} diverged: raise its velocity noise or use a better initial guess"
            )
        theta = x[2 * joints :]
    std = np.sqrt(np.maximum(np.diag(P)[2 * joints :], 0.0))
    return Filtered(names, theta * scale, std * scale)


def _scales(names: tuple[str, ...], start: Array) -> Array:
    """Return the scale of each parameter: the largest magnitude among the parameters of its kind."""
    groups = dict.fromkeys(("coupling", "armature"), "inertia") | dict.fromkeys(TORQUES, "torque")
    kinds = [groups.get(name.split("_")[0], name.split("_")[0]) for name in names]
    largest = {kind: max(abs(v) for v, k in zip(start, kinds, strict=True) if k == kind) for kind in kinds}
    return np.array([max(largest[kind], 1e-9) for kind in kinds])


def _accelerations(p: Any, width: float, q1: float, q2: float, v1: float, v2: float, t1: float, t2: float) -> Any:
    """Return the accelerations for the twelve constants `p`.

    A lower bound on the determinant keeps the accelerations finite if a filter's parameters leave the physical range.
    """
    across = p[1] * np.cos(q2)
    turning = p[1] * np.sin(q2)
    weight = p[5] * np.cos(q1 + q2)
    f1 = t1 - p[10] - p[4] * np.cos(q1) - weight + turning * (2.0 * v1 + v2) * v2 - p[6] * v1
    f1 -= p[8] * np.tanh(v1 / width)
    f2 = t2 - p[11] - weight - turning * v1 * v1 - p[7] * v2 - p[9] * np.tanh(v2 / width)
    m11 = p[0] + p[2] + 2.0 * across
    m12 = p[2] + across
    m22 = p[2] + p[3]
    determinant = max(m11 * m22 - m12 * m12, 1e-3 * abs(m11 * m22) + 1e-15)
    return (m22 * f1 - m12 * f2) / determinant, (m11 * f2 - m12 * f1) / determinant


def _advance(x: Any, t1: float, t2: float, dt: float, substeps: int, p: Any, width: float, joints: int) -> None:
    """Advance the angles and velocities (first elements of `x`) by `dt` with the classical Runge-Kutta method."""
    q1, v1 = x[0], x[joints]
    q2 = x[1] if joints == 2 else 0.0
    v2 = x[joints + 1] if joints == 2 else 0.0
    h = dt / substeps
    for _ in range(substeps):
        a1, a2 = _accelerations(p, width, q1, q2, v1, v2, t1, t2)
        b1, b2 = _accelerations(
            p, width, q1 + 0.5 * h * v1, q2 + 0.5 * h * v2, v1 + 0.5 * h * a1, v2 + 0.5 * h * a2, t1, t2
        )
        u1, u2 = v1 + 0.5 * h * a1, v2 + 0.5 * h * a2
        w1, w2 = v1 + 0.5 * h * b1, v2 + 0.5 * h * b2
        c1, c2 = _accelerations(p, width, q1 + 0.5 * h * u1, q2 + 0.5 * h * u2, w1, w2, t1, t2)
        z1, z2 = v1 + h * c1, v2 + h * c2
        d1, d2 = _accelerations(p, width, q1 + h * w1, q2 + h * w2, z1, z2, t1, t2)
        q1 += h / 6.0 * (v1 + 2.0 * u1 + 2.0 * w1 + z1)
        q2 += h / 6.0 * (v2 + 2.0 * u2 + 2.0 * w2 + z2)
        v1 += h / 6.0 * (a1 + 2.0 * b1 + 2.0 * c1 + d1)
        v2 += h / 6.0 * (a2 + 2.0 * b2 + 2.0 * c2 + d2)
    x[0] = q1
    x[joints] = v1
    if joints == 2:
        x[1] = q2
        x[joints + 1] = v2


def _constants(x: Any, scale: Any, slots: Any, fixed: Any, joints: int, p: Any) -> None:
    # Here and below, element by element: assigning slices takes seconds to compile.
    for i in range(fixed.size):
        p[i] = fixed[i]
    for i in range(slots.size):
        p[slots[i]] = x[2 * joints + i] * scale[i]


def _correct(x: Any, P: Any, R: Any, measured: Any) -> None:
    """Update `x` and `P` with a position sample, one joint at a time, since their errors are independent."""
    n = x.size
    for j in range(measured.size):
        s = P[j, j] + R[j]
        gain = P[:, j] / s
        x += gain * (measured[j] - x[j])
        row = P[j, :].copy()
        for a in range(n):
            for b in range(n):
                P[a, b] -= gain[a] * row[b]
    for a in range(n):
        for b in range(a):
            P[a, b] = P[b, a] = 0.5 * (P[a, b] + P[b, a])


def _root(P: Any) -> Any:
    """Return the lower-triangular square root of a covariance that rounding may have made slightly indefinite."""
    n = P.shape[0]
    root = np.zeros((n, n))
    for j in range(n):
        pivot = P[j, j]
        for k in range(j):
            pivot -= root[j, k] * root[j, k]
        root[j, j] = np.sqrt(max(pivot, 1e-10 * P[j, j] + 1e-20))
        for i in range(j + 1, n):
            rest = P[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            root[i, j] = rest / root[j, j]
    return root


def _ekf_loop(
    x: Any, P: Any, noise: Any, R: Any, position: Any, torque: Any, intervals: Any, substeps: int, scale: Any,
    slots: Any, fixed: Any, width: float,
) -> None:  # fmt: skip
    joints = position.shape[1]
    n = x.size
    p = np.empty(12)
    F = np.eye(n)
    for k in range(position.shape[0]):
        _correct(x, P, R, position[k])
        _constants(x, scale, slots, fixed, joints, p)
        ahead = x.copy()
        _advance(ahead, torque[k, 0], torque[k, 1], intervals[k], substeps, p, width, joints)
        for i in range(n):
            moved = x.copy()
            moved[i] += DIFFERENCE
            _constants(moved, scale, slots, fixed, joints, p)
            _advance(moved, torque[k, 0], torque[k, 1], intervals[k], substeps, p, width, joints)
            for j in range(2 * joints):
                F[j, i] = (moved[j] - ahead[j]) / DIFFERENCE
        spread = F @ P @ F.T
        for i in range(n):
            x[i] = ahead[i]
            for j in range(n):
                P[i, j] = spread[i, j]
            P[i, i] += noise[i] * intervals[k]


def _ukf_loop(
    x: Any, P: Any, noise: Any, R: Any, position: Any, torque: Any, intervals: Any, substeps: int, scale: Any,
    slots: Any, fixed: Any, width: float,
) -> None:  # fmt: skip
    joints = position.shape[1]
    n = x.size
    p = np.empty(12)
    points = np.empty((2 * n, n))
    reach = np.sqrt(float(n))
    for k in range(position.shape[0]):
        _correct(x, P, R, position[k])
        root = _root(P)
        for i in range(n):
            for j in range(n):
                points[i, j] = x[j] + reach * root[j, i]
                points[n + i, j] = x[j] - reach * root[j, i]
        for i in range(2 * n):
            _constants(points[i], scale, slots, fixed, joints, p)
            _advance(points[i], torque[k, 0], torque[k, 1], intervals[k], substeps, p, width, joints)
        for a in range(n):
            x[a] = np.mean(points[:, a])
        away = points - x
        spread = away.T @ away
        for i in range(n):
            for j in range(n):
                P[i, j] = spread[i, j] / (2.0 * n)
            P[i, i] += noise[i] * intervals[k]


_accelerations = compiled(_accelerations)
_advance = compiled(_advance)
_constants = compiled(_constants)
_correct = compiled(_correct)
_root = compiled(_root)
_ekf: Callable[..., None] = compiled(_ekf_loop)
_ukf: Callable[..., None] = compiled(_ukf_loop)
