"""Stage 1 for chains: linear least squares on the Fourier coefficients of settled periods, with a weak prior.

It works like `hil.estimator.fit.stage1`, with the chain's regressor. Base parameters that the motion does not determine
come from the prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.fourier import Lines, PeriodicMotion, cut_off, held_lines, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod

COULOMB_WIDTH = 0.05  # rad/s: roughly the velocity error that omitting Fourier lines causes while a joint sticks
PASSES = 3


@dataclass(frozen=True)
class ChainLinear:
    """Result of the regression."""

    value: Array
    """Values in the order of `ChainModel.linear_names` [SI]."""
    std: Array
    """Standard errors assuming a white residual, in the order of `value` [SI]."""
    delay: float
    """Delay of the motor torque [s]."""
    motions: tuple[PeriodicMotion, ...]
    """Motion of each period, computed from its Fourier coefficients."""
    relative_residual: Array
    """RMS torque residual of each joint, relative to the RMS of its torque (joints,)."""


def fit_lines(
    periods: Sequence[SettledPeriod], model: ChainModel, prior: Prior, added: Sequence[Array | None] = ()
) -> ChainLinear:
    """From settled periods, estimate the parameters in which the torque is linear.

    added: change in the base parameters due to the known mass in each period (base parameters,) [SI]; None without a
    mass.
    """
    lines = [lines_of(period.filled()) for period in periods]
    highest = list(map(cut_off, lines))
    motions = tuple(
        motion_of(line, most, period.fundamental, period.samples)
        for line, most, period in zip(lines, highest, periods, strict=True)
    )
    known = tuple(added) or (None,) * len(periods)
    equations = [_equations(*each, model) for each in zip(periods, motions, highest, known, strict=True)]
    A = np.concatenate([columns for columns, _ in equations], axis=1)
    torque = np.concatenate([goal for _, goal in equations], axis=1)
    level = np.sqrt(np.mean(np.abs(torque) ** 2, axis=1))
    left = np.maximum(level, 1e-12)
    for _ in range(PASSES):
        theta, std = solve(A, torque, 1.0 / left, prior)
        left = np.maximum(np.sqrt(np.mean(np.abs(torque - A @ theta) ** 2, axis=1)), 1e-6 * level)
    return ChainLinear(theta[:-1], std[:-1], float(theta[-1]), motions, left / np.maximum(level, 1e-12))


def columns_of(model: ChainModel, motion: PeriodicMotion) -> Array:
    """Return the regressor of `ChainModel.linear_names` (joints, samples, names)."""
    rigid = model.base.regressor(motion.position, motion.velocity, motion.acceleration)
    return np.concatenate((rigid, columns_of_friction(motion)), axis=2)


def columns_of_friction(motion: PeriodicMotion) -> Array:
    """Return the regressor of viscous friction, Coulomb friction and offsets (joints, samples, 3 * joints), by term."""
    joints, samples = motion.velocity.shape
    Y = np.zeros((joints, samples, 3 * joints))
    for joint, velocity in enumerate(motion.velocity):
        Y[joint, :, joint] = velocity
        Y[joint, :, joints + joint] = np.tanh(velocity / COULOMB_WIDTH)
        Y[joint, :, 2 * joints + joint] = 1.0
    return Y


def solve(columns: Array | Lines, torque: Array | Lines, weight: Array, prior: Prior) -> tuple[Array, Array]:
    """Solve for the parameters by weighted least squares; return values and standard errors.

    Args:
        columns: regressor (joints, rows, unknowns), whose first unknowns are the base parameters.
        torque: torques (joints, rows) [N m].
        weight: inverse standard deviation of a row (joints,) [1/(N m)].
        prior: prior on the base parameters.
    """
    weighted = (columns * weight[:, None, None]).reshape(-1, columns.shape[2])
    goal = (torque * weight[:, None]).reshape(-1)
    A = np.concatenate((weighted.real, weighted.imag)) if np.iscomplexobj(weighted) else weighted
    b = np.concatenate((goal.real, goal.imag)) if np.iscomplexobj(goal) else goal
    count = prior.value.size
    believed = np.zeros((count, A.shape[1]))
    believed[:, :count] = np.diag(1.0 / prior.std)
    A = np.concatenate((np.asarray(A, dtype=np.float64), believed))
    b = np.concatenate((np.asarray(b, dtype=np.float64), prior.value / prior.std))
    norm = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    theta = linalg.lstsq(A / norm, b, rcond=1e-12)[0]
    left = b - A @ (theta / norm)
    variance = float(left @ left) / max(1, b.size - theta.size)
    spread = np.sqrt(variance * np.diag(linalg.pinv((A / norm).T @ (A / norm), hermitian=True)))
    return theta / norm, spread / norm


def _equations(
    period: SettledPeriod, motion: PeriodicMotion, highest: int, added: Array | None, model: ChainModel
) -> tuple[Lines, Lines]:
    """Return one period's columns (joints, lines, unknowns) and torques (joints, lines)."""
    Y = columns_of(model, motion)
    columns = np.stack([np.fft.rfft(rows, axis=0)[: highest + 1] for rows in Y]) / period.samples
    torque = held_lines(period.torque, period.rate, -period.command_to_sample)[:, : highest + 1]
    if added is not None:
        torque = torque - columns[:, :, : added.size] @ added
    slope = 1j * period.fundamental * np.arange(highest + 1) * torque
    return np.concatenate((columns, slope[:, :, None]), axis=2), torque
