"""How friction changed while the arm moved: grease that warms up makes it fall by some percent within minutes.

A fit of one period, or of the mean of several, holds for their middle. Other periods then show by how much friction was
larger or smaller: what they differ by is nearly linear in one factor of each joint's friction, viscous and dry, and in
the state with which the period began.
"""

from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.selection.candidates import colour, simulated_run

ITERATIONS = 3
LEAST = 0.005  # of friction: a change that matters
MOST = 0.3  # change of friction in one iteration
SCALED = ("viscous", "coulomb", "load", "viscous_asymmetry")


@dataclass(frozen=True)
class Drift:
    """By how much each joint's friction changed from the fitted periods to later ones."""

    change: Array
    """As a fraction (joints,); negative when it fell."""
    std: Array
    """Its standard error (joints,)."""
    seconds: float
    """Time between the middles of what is compared [s]."""

    @property
    def is_seen(self) -> bool:
        """Whether any joint's friction changed beyond chance, and by more than half a percent."""
        return bool(np.any((np.abs(self.change) > 3.0 * self.std) & (np.abs(self.change) > LEAST)))

    def at_the_later(self, estimate: Estimate) -> Estimate:
        """The estimate with friction as it was later."""
        factor = 1.0 + self.change
        value = estimate.value.copy()
        for joint in range(estimate.model.joints):
            for name in SCALED:
                if f"{name}_{joint + 1}" in estimate.names:
                    value[estimate.names.index(f"{name}_{joint + 1}")] *= factor[joint]
        return replace(estimate, value=value)


def friction_change(period: SettledPeriod, estimate: Estimate, seconds: float) -> Drift:
    """By how much friction in `period` differs from that of `estimate`, `seconds` [s] earlier.

    Gauss-Newton on one factor of each joint and the first state; all else is taken as known.
    """
    joints = period.joints
    run = simulated_run(period)
    weight = np.where(period.valid, 1.0 / period.noise[:, None], 0.0)
    change, state = np.zeros(joints), _first_state(period)
    names = [f"{name}_{joint + 1}" for joint in range(joints) for name in SCALED]
    names = [name for name in names if name in estimate.names]
    for _ in range(ITERATIONS):
        changed = Drift(change, change, seconds).at_the_later(estimate)
        physics = Physics.of(changed.parameters)
        columns, residual = [], []
        for part, position, derivative in run.pieces(physics, state, tuple(names)):
            columns.append(derivative * weight[:, part, None])
            residual.append(weight[:, part] * (run.measured[:, part] - position))
        J = np.concatenate(columns, axis=1)
        r = np.concatenate(residual, axis=1).reshape(-1)
        by_factor = np.zeros((*J.shape[:2], joints))
        for i, name in enumerate(names):
            joint = int(name.rsplit("_", 1)[1]) - 1
            by_factor[:, :, joint] += J[:, :, i] * estimate.parameters[name]
        A = np.concatenate((by_factor, J[:, :, len(names) :]), axis=2).reshape(r.size, -1)
        step = np.linalg.lstsq(A, r, rcond=None)[0]
        change = change + np.clip(step[:joints], -MOST, MOST)
        state = state + step[joints:].reshape(2, -1)
    inverse = np.linalg.pinv(A.T @ A, hermitian=True)
    rest = r - A @ step
    std = np.sqrt(
        np.diag(inverse)[:joints] * float(rest @ rest) / max(1, r.size - A.shape[1]) * colour(rest.reshape(joints, -1))
    )
    return Drift(change, std, seconds)


def _first_state(period: SettledPeriod) -> Array:
    """Angles and velocities at the first sample (2, joints), from the lines of the motion."""
    lines = lines_of(period.filled())
    motion = motion_of(lines, cut_off(lines), period.fundamental, period.samples)
    return np.stack((motion.position[:, 0], motion.velocity[:, 0]))
