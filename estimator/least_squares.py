"""Stage 1: linear least squares on the Fourier lines of one settled period. No starting values, no local
minima.

The motion's lines up to where signal meets noise are differentiated exactly, the regressor evaluated on
them, and regressor and torque compared line by line. The command's own derivative is one more column, whose
coefficient is the delay of the motors: tau(t - delay) = tau(t) - delay tau'(t).
"""

from dataclasses import dataclass

import numpy as np

from estimator.arm_model import parameter_names, regressor
from estimator.arrays import Array
from estimator.errors import UnidentifiableError
from estimator.fourier import Lines, Motion, cut_off, held_lines, lines_of, motion_of
from estimator.period import SettledPeriod

COULOMB_WIDTH = 0.05  # rad/s: about the velocity that the dropped lines leave in a sticking joint
WORST_CONDITION = 1e8


@dataclass(frozen=True)
class LinearEstimate:
    """What the regression found."""

    names: tuple[str, ...]
    """Base parameters."""
    value: Array
    """(parameters,) [SI]."""
    std: Array
    """Standard errors if the residual were white (parameters,): optimistic for other friction."""
    delay: float
    """Delay of the motors' torque [s]."""
    motion: Motion
    """The period's motion from its lines up to `harmonics`."""
    harmonics: int
    """Highest harmonic used."""


def fit_lines(period: SettledPeriod) -> LinearEstimate:
    """Estimate the base parameters. Raises UnidentifiableError when the motion does not tell them apart."""
    lines = lines_of(period.filled())
    harmonics = cut_off(lines)
    motion = motion_of(lines, harmonics, period.fundamental, period.samples)
    Y = regressor(motion.position, motion.velocity, motion.acceleration, COULOMB_WIDTH)
    columns = np.fft.rfft(Y, axis=1)[:, : harmonics + 1] / period.samples
    torque = held_lines(period.torque, period.rate, -period.command_to_sample)[:, : harmonics + 1]
    slope = 1j * period.fundamental * np.arange(harmonics + 1) * torque
    A = np.concatenate((columns, slope[:, :, None]), axis=2)

    theta, _ = _solve(A, torque, np.ones(period.joints))
    # The second time each joint counts by what the first left unexplained of it.
    left = np.sqrt(np.mean(np.abs(torque - A @ theta) ** 2, axis=1))
    theta, std = _solve(A, torque, 1.0 / left)
    return LinearEstimate(parameter_names(period.joints), theta[:-1], std[:-1], float(theta[-1]), motion, harmonics)


def _solve(columns: Lines, torque: Lines, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of complex `torque` (joints, lines) on `columns` (joints, lines, unknowns)."""
    weighted = (columns * weight[:, None, None]).reshape(-1, columns.shape[2])
    A = np.concatenate((weighted.real, weighted.imag))
    goal = (torque * weight[:, None]).reshape(-1)
    b = np.concatenate((goal.real, goal.imag))
    norm = np.linalg.norm(A, axis=0)
    U, size, Vt = np.linalg.svd(A / np.where(norm > 0.0, norm, 1.0), full_matrices=False)
    if size[-1] * WORST_CONDITION < size[0]:
        raise UnidentifiableError(
            f"the regression's condition is {size[0] / max(size[-1], 1e-300):.2g}, at most "
            f"{WORST_CONDITION:.0e} can be solved: the motion does not tell parameters apart; "
            "excite more lines or raise the torque"
        )
    theta = Vt.T @ ((U.T @ b) / size)
    left = b - A @ (theta / norm)
    variance = float(left @ left) / max(1, b.size - theta.size)
    std = np.sqrt(variance * np.sum((Vt.T / size) ** 2, axis=1))
    return theta / norm, std / norm
