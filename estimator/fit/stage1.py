"""Stage 1: linear least squares on Fourier coefficients of settled periods, without initial guesses or local minima.

The motion's lines above the noise are differentiated exactly, the regressor is evaluated on the resulting motion, and
regressor and torque are compared line by line. The command's derivative is an additional column, whose coefficient is
the delay of the motors: tau(t - delay) = tau(t) - delay tau'(t).
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.fourier import Lines, PeriodicMotion, cut_off, held_lines, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ShapeError, UnidentifiableError
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names
from hil.estimator.options import LinearOptions

DEFAULTS = LinearOptions()


@dataclass(frozen=True)
class LinearEstimate:
    """Result of the regression."""

    names: tuple[str, ...]
    """Names of the base parameters."""
    value: Array
    """Parameter values (parameters,) [SI]."""
    std: Array
    """Standard errors assuming a white residual (parameters,); too optimistic if the friction model is wrong."""
    delay: float
    """Delay of the motors' torque [s]."""
    motions: tuple[PeriodicMotion, ...]
    """Motion of each period, reconstructed from its lines up to `harmonics`."""
    harmonics: tuple[int, ...]
    """Highest harmonic of each period that the regression uses."""

    @property
    def motion(self) -> PeriodicMotion:
        """Motion of the first period."""
        return self.motions[0]


def fit_lines(*periods: SettledPeriod, options: LinearOptions = DEFAULTS) -> LinearEstimate:
    """Estimate the base parameters from one or more settled periods of one arm.

    Raises UnidentifiableError if the motion does not separate them, or ShapeError if the periods differ in their number
    of joints.
    """
    joints = periods[0].joints
    if any(period.joints != joints for period in periods):
        raise ShapeError(f"the periods have {[period.joints for period in periods]} joints: they must be of one arm")
    lines = [lines_of(period.filled()) for period in periods]
    harmonics = tuple(map(cut_off, lines))
    motions = tuple(
        motion_of(line, highest, period.fundamental, period.samples)
        for line, highest, period in zip(lines, harmonics, periods, strict=True)
    )
    width = options.coulomb_width
    equations = [_equations(*each, width) for each in zip(periods, motions, harmonics, strict=True)]
    A = np.concatenate([columns for columns, _ in equations], axis=1)
    torque = np.concatenate([goal for _, goal in equations], axis=1)

    theta, _ = _solve(A, torque, np.ones(joints), options.max_condition)
    # In the second pass, each joint is weighted by its residual in the first.
    left = np.sqrt(np.mean(np.abs(torque - A @ theta) ** 2, axis=1))
    weight = 1.0 / np.maximum(left, 1e-12 * np.abs(torque).max())
    theta, std = _solve(A, torque, weight, options.max_condition)
    return LinearEstimate(base_names(joints), theta[:-1], std[:-1], float(theta[-1]), motions, harmonics)


def _equations(
    period: SettledPeriod, motion: PeriodicMotion, harmonics: int, coulomb_width: float
) -> tuple[Lines, Lines]:
    """Return one period's columns (joints, lines, unknowns) and torques (joints, lines)."""
    Y = regressor(motion.position, motion.velocity, motion.acceleration, coulomb_width)
    # One joint at a time: the spectra of all regressors of a long period at once would fill the memory.
    columns = np.stack([np.fft.rfft(rows, axis=0)[: harmonics + 1] for rows in Y]) / period.samples
    torque = held_lines(period.torque, period.rate, -period.command_to_sample)[:, : harmonics + 1]
    slope = 1j * period.fundamental * np.arange(harmonics + 1) * torque
    return np.concatenate((columns, slope[:, :, None]), axis=2), torque


def _solve(columns: Lines, torque: Lines, weight: Array, max_condition: float) -> tuple[Array, Array]:
    """Solve for complex `torque` (joints, lines) by weighted least squares on `columns` (joints, lines, unknowns)."""
    weighted = (columns * weight[:, None, None]).reshape(-1, columns.shape[2])
    A = np.concatenate((weighted.real, weighted.imag))
    goal = (torque * weight[:, None]).reshape(-1)
    b = np.concatenate((goal.real, goal.imag))
    norm = np.linalg.norm(A, axis=0)
    U, size, Vt = linalg.svd(A / np.where(norm > 0.0, norm, 1.0), full_matrices=False)
    if size[-1] * max_condition < size[0]:
        raise UnidentifiableError(
            f"the regression's condition number, {size[0] / max(size[-1], 1e-300):.2g}, exceeds the limit of "
            f"{max_condition:.0e} because the motion does not separate the parameters: "
            "excite more lines or raise the torque"
        )
    theta = Vt.T @ ((U.T @ b) / size)
    left = b - A @ (theta / norm)
    variance = float(left @ left) / max(1, b.size - theta.size)
    std = np.sqrt(variance * np.sum((Vt.T / size) ** 2, axis=1))
    return theta / norm, std / norm
