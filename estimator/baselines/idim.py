"""Filtered inverse-dynamics least squares (IDIM-LS), the standard method of the field; used for initial guesses and for
comparison.

The position is low-pass filtered forwards and backwards and differentiated by central differences, and the regressor is
evaluated. Regressor and torque are filtered identically and decimated, and one weighted linear least-squares problem is
solved: Gautier and Poignet, "Extended Kalman filtering and weighted least squares dynamic identification of robot",
Control Engineering Practice 9 (2001) 1361; Swevers, Verdonck, De Schutter, "Dynamic model identification for industrial
robots", IEEE Control Systems 27 (2007) 58.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError, UnidentifiableError
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names

ORDER = 4  # order of the Butterworth filter, doubled by filtering in both directions
TRIM = 1.5  # cycles of the cut-off frequency discarded at either end because of filter transients
PER_CYCLE = 5.0  # samples kept per cycle of the cut-off frequency
WORST_CONDITION = 1e8


@dataclass(frozen=True)
class Rows:
    """Filtered regressors and torques, decimated to roughly the rate that their bandwidth requires."""

    regressor: Array
    """Regressors (joints, samples, parameters)."""
    torque: Array
    """Torques (joints, samples) [N m]."""


@dataclass(frozen=True)
class InverseDynamics:
    """Result of the regression."""

    names: tuple[str, ...]
    """Names of the base parameters."""
    value: Array
    """Values (parameters,) [SI]."""
    std: Array
    """Standard errors assuming a white residual (parameters,) [SI]."""
    relative_residual: Array
    """RMS torque residual of each joint, relative to the RMS of its torque (joints,)."""


def uniform(recording: Recording, delay: float = 0.0) -> tuple[Array, Array, float]:
    """Return positions and torques (joints, samples) at equal intervals, and the interval [s].

    Each torque is the mean over the interval centred on its position sample, so that holding commands between samples
    adds no lag.
    """
    dt = recording.interval
    count = int((recording.time[-1] - recording.time[0]) / dt)
    at = recording.time[0] + dt * np.arange(count)
    filled = recording.filled()
    position = np.stack([np.interp(at, recording.time, row) for row in filled])
    edges = recording.time[0] + dt * (np.arange(count + 1) - 0.5)
    return position, recording.mean_torque(edges, delay), dt


MoreColumns = Callable[[Array], Array]
"""Additional regressor columns (joints, samples, columns) as a function of the positions (joints, samples)."""


def filtered_rows(
    recording: Recording,
    cutoff: float,
    coulomb_width: float,
    delay: float = 0.0,
    position_cutoff: float | None = None,
    more: MoreColumns | None = None,
) -> Rows:
    """Return the rows of the regression; arguments as in `fit_inverse_dynamics`.

    Raises RecordingError if the recording is too short for the filter or its sample rate is too low.
    """
    position, torque, dt = uniform(recording, delay)
    trim = int(np.ceil(TRIM / (cutoff * dt)))
    keep = max(1, int(1.0 / (PER_CYCLE * cutoff * dt)))
    highest = max(cutoff, position_cutoff or cutoff)
    if highest >= 0.45 / dt or position.shape[1] < 3 * trim:
        raise RecordingError(
            f"{position.shape[1]} samples at {1 / dt:.4g}/s cannot be filtered at {highest:g} Hz: "
            "record for longer, or at a higher sample rate"
        )
    from scipy.signal import butter, sosfiltfilt

    filter_ = butter(ORDER, cutoff, fs=1.0 / dt, output="sos")
    tau = sosfiltfilt(filter_, torque, axis=1)
    # As bytes, which can be hashed and are compared fast; arrays cannot be hashed.
    given = position.tobytes(), position.shape[0], dt, cutoff, position_cutoff or cutoff, coulomb_width
    Y = _filtered_regressor(*given, trim, keep)
    if more is not None:
        Y = np.concatenate((Y, sosfiltfilt(filter_, more(position), axis=1)[:, trim:-trim:keep]), axis=2)
    return Rows(Y, tau[:, trim:-trim:keep])


@lru_cache(maxsize=4)  # the search for faults tries hundreds of torques with the same positions
def _filtered_regressor(
    positions: bytes,
    joints: int,
    dt: float,
    cutoff: float,
    position_cutoff: float,
    coulomb_width: float,
    trim: int,
    keep: int,
) -> Array:
    from scipy.signal import butter, sosfiltfilt

    position = np.frombuffer(positions).reshape(joints, -1)
    smooth = sosfiltfilt(butter(ORDER, position_cutoff, fs=1.0 / dt, output="sos"), position, axis=1)
    velocity = np.gradient(smooth, dt, axis=1)
    acceleration = np.gradient(velocity, dt, axis=1)
    terms = regressor(smooth, velocity, acceleration, coulomb_width)
    Y = sosfiltfilt(butter(ORDER, cutoff, fs=1.0 / dt, output="sos"), terms, axis=1)[:, trim:-trim:keep].copy("K")
    Y.flags.writeable = False
    return Y


def fit_inverse_dynamics(
    recordings: Sequence[Recording],
    cutoff: float,
    coulomb_width: float,
    delay: float = 0.0,
    position_cutoff: float | None = None,
    more: MoreColumns | None = None,
) -> InverseDynamics:
    """Fit all `recordings` by IDIM-LS, weighting each joint according to its torque residual in the previous solution.

    cutoff: cut-off frequency for regressors and torques [Hz].
    coulomb_width: width of the smoothed Coulomb step [rad/s].
    delay: delay of the torque [s].
    position_cutoff: cut-off frequency for the positions from which regressors are computed [Hz]; by default `cutoff`.
    more: additional regressor columns; their coefficients follow the base parameters and have no names.
    Raises RecordingError, UnidentifiableError.
    """
    rows = [filtered_rows(recording, cutoff, coulomb_width, delay, position_cutoff, more) for recording in recordings]
    Y = np.concatenate([row.regressor for row in rows], axis=1)
    tau = np.concatenate([row.torque for row in rows], axis=1)
    weight = np.ones(len(Y))
    for _ in range(3):
        theta, std = _solve(Y, tau, weight)
        left = np.sqrt(np.mean((tau - Y @ theta) ** 2, axis=1))
        weight = 1.0 / np.maximum(left, 1e-12)
    level = np.sqrt(np.mean(tau**2, axis=1))
    return InverseDynamics(base_names(len(Y)), theta, std, left / np.where(level > 0.0, level, 1.0))


def _solve(Y: Array, tau: Array, weight: Array) -> tuple[Array, Array]:
    A = (Y * weight[:, None, None]).reshape(-1, Y.shape[2])
    b = (tau * weight[:, None]).reshape(-1)
    norm = np.linalg.norm(A, axis=0)
    U, size, Vt = linalg.svd(A / np.where(norm > 0.0, norm, 1.0), full_matrices=False)
    if size[-1] * WORST_CONDITION < size[0] or np.any(norm == 0.0):
        raise UnidentifiableError(
            "filtered inverse dynamics: the motion does not separate the parameters; move both joints faster and "
            "farther"
        )
    theta = Vt.T @ ((U.T @ b) / size)
    left = b - A @ (theta / norm)
    variance = float(left @ left) / max(1, b.size - theta.size)
    return theta / norm, np.sqrt(variance * np.sum((Vt.T / size) ** 2, axis=1)) / norm
