"""Changes in friction during motion: as grease warms up, friction falls by a few percent within minutes.

A fit of one period, or of the mean of several periods, is valid for the middle of the time that it covers. Other
periods then show whether friction was larger or smaller: the difference in motion is nearly linear in one factor per
joint, which multiplies viscous and dry friction, and in the period's initial state. Alternatively, a constant torque in
only one of the periods may have caused the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.objective import Run
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.selection.candidates import by_parameters, colour, linearised, simulated_run

ITERATIONS = 3
LEAST = 0.005  # minimum relative change in friction that matters
MOST = 0.3  # maximum relative change in friction in one iteration
SHARES = (1.0, 0.5, 0.2, 0.05)  # fractions of a step, tried in turn until the prediction improves
TELLS = 0.5  # a constant torque explains more if it leaves less than this fraction of what a change in friction leaves
NOTICED = 0.01  # constant torque, relative to the joint's RMS torque, below which it does not matter
UNEVEN = 0.25  # fraction of a change that may not be linear in time, or not the same for all friction terms
SCALED = ("viscous", "coulomb", "load", "viscous_asymmetry")


@dataclass(frozen=True)
class Drift:
    """Relative change in each joint's friction from the fitted periods to later ones."""

    change: Array
    """Change as a fraction of the friction in the fitted periods (joints,); negative if friction fell."""
    std: Array
    """Standard error of the change (joints,)."""
    seconds: float
    """Time between the midpoints of the periods that are compared [s]."""
    left: float = np.inf
    """Sum of squares of the residual that the change does not explain, in units of the noise."""

    @property
    def is_seen(self) -> bool:
        """Whether any joint's friction changed significantly and by more than half a percent."""
        return bool(np.any((np.abs(self.change) > 3.0 * self.std) & (np.abs(self.change) > LEAST)))

    def after_correction(self) -> "Drift":
        """Return the change that may remain after a correction: the error of the measured change, and the part that is
        not linear in time.
        """
        return replace(self, change=np.hypot(self.std, UNEVEN * self.change))

    def at_the_later(self, estimate: Estimate) -> Estimate:
        """Return the estimate with the friction of the later periods."""
        factor = 1.0 + self.change
        value = estimate.value.copy()
        for joint in range(estimate.model.joints):
            for name in SCALED:
                if f"{name}_{joint + 1}" in estimate.names:
                    value[estimate.names.index(f"{name}_{joint + 1}")] *= factor[joint]
        return replace(estimate, value=value)


def drifting(period: SettledPeriod, estimate: Estimate, drift: Drift) -> Array:
    """Return the estimate's covariance (parameters, parameters) [SI], including the effect of friction that changed
    during `period`.

    The fit assumes constant friction. If friction changes at the rate of `drift`, other parameters absorb part of this
    slow change in torque. The motion is assumed to follow the instantaneous friction, which holds if transients decay
    within a small part of the period.
    """
    about = linearised(period, estimate, (), {})
    derivative = by_parameters(period, estimate)
    seconds = np.arange(period.samples) / period.rate
    since = (seconds - seconds.mean()) / drift.seconds
    own = linalg.pinv(about.normal + about.expected * about.colour, rcond=1e-11, hermitian=True)
    wider = estimate.covariance.copy()
    seen = np.isfinite(np.diag(wider))
    for joint in range(period.joints):
        names = [f"{name}_{joint + 1}" for name in SCALED]
        friction = sum(
            derivative[:, :, estimate.names.index(name)] * estimate.parameters[name]
            for name in names
            if name in estimate.names
        )
        changed = friction * since * drift.change[joint]
        shift = own @ np.einsum("jsc,js->c", derivative, changed)
        moved = shift[: len(estimate.names)]
        wider += np.where(np.outer(seen, seen), np.outer(moved, moved), 0.0)
    return wider


def friction_change(period: SettledPeriod, estimate: Estimate, seconds: float) -> Drift:
    """Return the change in friction from `estimate` to `period`, which is `seconds` [s] later.

    It is found by Gauss-Newton iterations on one factor per joint and the initial state; all other parameters are
    fixed. A step that does not improve the prediction is shortened. If no simulation from the period's start stays
    finite, the standard error is infinite.
    """
    change, std, left = _fitted(_Later.of(period, estimate, SCALED), period, MOST)
    return Drift(change, std, seconds, left)


@dataclass(frozen=True)
class TorqueChange:
    """Constant torque on each joint in the later periods only."""

    change: Array
    """Torque (joints,) [N m]."""
    std: Array
    """Standard error of the torque (joints,) [N m]."""
    left: float
    """Sum of squares of the residual that the torque does not explain, in units of the noise."""
    noticed: Array
    """Smallest constant torque that matters, for each joint (joints,) [N m]."""

    @property
    def is_seen(self) -> Mask:
        """Whether each joint's torque changed significantly, and by enough to matter (joints,)."""
        seen: Mask = (np.abs(self.change) > 3.0 * self.std) & (np.abs(self.change) > self.noticed)
        return seen

    def explains_better_than(self, drift: Drift) -> bool:
        """Whether a change in constant torque is significant and explains much more than a change in friction does."""
        return bool(self.is_seen.any()) and self.left < TELLS * drift.left


def torque_change(period: SettledPeriod, estimate: Estimate) -> TorqueChange:
    """Return the constant torque in `period` that `estimate` lacks, found as in `friction_change`."""
    size = np.sqrt(np.mean(period.torque**2, axis=1))
    return TorqueChange(*_fitted(_Later.of(period, estimate, ("offset",)), period, size), NOTICED * size)


def _fitted(later: "_Later", period: SettledPeriod, most: float | Array) -> tuple[Array, Array, float]:
    """Return the change (joints,), its standard error and the remaining sum of squares.

    most: largest permitted change in one iteration.
    """
    joints = period.joints
    change, state = np.zeros(joints), _first_state(period)
    A, r = later.linear(change, state)
    if not _is_finite(A, r):
        return change, np.full(joints, np.inf), np.inf
    for _ in range(ITERATIONS):
        step = linalg.lstsq(A, r, rcond=None)[0]
        for share in SHARES:
            further = change + np.clip(share * step[:joints], -most, most)
            start = state + share * step[joints:].reshape(2, -1)
            trial = later.linear(further, start)
            if _is_finite(*trial) and trial[1] @ trial[1] <= r @ r:
                change, state, (A, r) = further, start, trial
                break
        else:
            break
    inverse = linalg.pinv(A.T @ A, hermitian=True)
    rest = r - A @ linalg.lstsq(A, r, rcond=None)[0]
    std = np.sqrt(
        np.diag(inverse)[:joints] * float(rest @ rest) / max(1, r.size - A.shape[1]) * colour(rest.reshape(joints, -1))
    )
    return change, std, float(r @ r)


@dataclass(frozen=True)
class _Later:
    """The later period as predicted by an estimate whose parameters `names` may change."""

    estimate: Estimate
    run: Run
    weight: Array
    names: tuple[str, ...]

    @classmethod
    def of(cls, period: SettledPeriod, estimate: Estimate, kinds: Sequence[str]) -> "_Later":
        names = (f"{name}_{joint}" for joint in range(1, period.joints + 1) for name in kinds)
        weight = np.where(period.valid, 1.0 / period.noise[:, None], 0.0)
        return cls(estimate, simulated_run(period), weight, tuple(name for name in names if name in estimate.names))

    def linear(self, change: Array, state: Array) -> tuple[Array, Array]:
        """Return the derivatives (samples of all joints, joints + 2 joints) and the weighted residual (samples of all
        joints,) of a simulation from `state` (2, joints) with the parameters changed by `change` (joints,).
        """
        physics = Physics.of(self._changed(change))
        columns, residual = [], []
        for part, position, derivative in self.run.pieces(physics, state, self.names):
            columns.append(derivative * self.weight[:, part, None])
            residual.append(self.weight[:, part] * (self.run.measured[:, part] - position))
        J = np.concatenate(columns, axis=1)
        r = np.concatenate(residual, axis=1).reshape(-1)
        by_factor = np.zeros((*J.shape[:2], change.size))
        for i, name in enumerate(self.names):
            by_factor[:, :, _joint_of(name)] += J[:, :, i] * self._scale(name)
        return np.concatenate((by_factor, J[:, :, len(self.names) :]), axis=2).reshape(r.size, -1), r

    def _scale(self, name: str) -> float:
        """Return a parameter's change per unit of `change`: its own value for friction, 1 for a torque [N m]."""
        return 1.0 if name.startswith("offset") else self.estimate.parameters[name]

    def _changed(self, change: Array) -> dict[str, float]:
        parameters = dict(self.estimate.parameters)
        for name in self.names:
            parameters[name] += self._scale(name) * float(change[_joint_of(name)])
        return parameters


def _joint_of(name: str) -> int:
    return int(name.rsplit("_", 1)[1]) - 1


def _is_finite(A: Array, r: Array) -> bool:
    return bool(np.isfinite(r).all() and np.isfinite(A).all())


def _first_state(period: SettledPeriod) -> Array:
    """Return angles and velocities at the first sample (2, joints), computed from the motion's Fourier coefficients."""
    lines = lines_of(period.filled())
    motion = motion_of(lines, cut_off(lines), period.fundamental, period.samples)
    return np.stack((motion.position[:, 0], motion.velocity[:, 0]))
