"""Filtered inverse dynamics for chains, the classical method: linear least squares on any recording.

The regressor is evaluated on filtered, differentiated positions and then filtered like the torques (Gautier, Janot,
Vandanjon, IEEE Transactions on Control Systems Technology 21 (2013) 428). Measured torques can be used as well as
commanded ones. With quantised positions, the result is biased and much less accurate than stage 2.
"""

from collections.abc import Sequence

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import ORDER, PER_CYCLE, TRIM, uniform
from hil.estimator.chain.fit.stage1 import PASSES, columns_of, solve
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.fourier import PeriodicMotion
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError


def fit_filtered(
    recordings: Sequence[Recording], model: ChainModel, prior: Prior, cutoff: float, delay: float = 0.0
) -> tuple[Array, Array]:
    """Return the values of `ChainModel.linear_names` and their standard errors, assuming a white residual [SI].

    cutoff: cut-off frequency of the filter [Hz]. delay: delay of the torque [s]. Raises RecordingError if the recording
    cannot be filtered.
    """
    Y, tau = filtered_torques(recordings, model, cutoff, delay)
    left = np.maximum(np.sqrt(np.mean(tau**2, axis=1)), 1e-9)
    for _ in range(PASSES):
        theta, std = solve(Y, tau, 1.0 / left, prior)
        left = np.maximum(np.sqrt(np.mean((tau - Y @ theta) ** 2, axis=1)), 1e-9)
    return theta, std


def filtered_torques(
    recordings: Sequence[Recording], model: ChainModel, cutoff: float, delay: float
) -> tuple[Array, Array]:
    """Return the rows of `filtered_torque` for all recordings, concatenated."""
    rows = [filtered_torque(recording, model, cutoff, delay) for recording in recordings]
    return np.concatenate([Y for Y, _ in rows], axis=1), np.concatenate([tau for _, tau in rows], axis=1)


def filtered_torque(recording: Recording, model: ChainModel, cutoff: float, delay: float) -> tuple[Array, Array]:
    """Return the filtered regressor of `ChainModel.linear_names` (joints, rows, names) and torque (joints, rows)."""
    position, torque, dt = uniform(recording, delay)
    trim = int(np.ceil(TRIM / (cutoff * dt)))
    keep = max(1, int(1.0 / (PER_CYCLE * cutoff * dt)))
    if cutoff >= 0.45 / dt or position.shape[1] < 3 * trim:
        raise RecordingError(
            f"{position.shape[1]} samples at {1 / dt:.4g}/s cannot be filtered at {cutoff:g} Hz: record for longer, or "
            "at a higher sample rate"
        )
    from scipy.signal import butter, sosfiltfilt

    sos = butter(ORDER, cutoff, fs=1.0 / dt, output="sos")
    smooth = sosfiltfilt(sos, position, axis=1)
    velocity = np.gradient(smooth, dt, axis=1)
    motion = PeriodicMotion(smooth, velocity, np.gradient(velocity, dt, axis=1))
    Y = sosfiltfilt(sos, columns_of(model, motion), axis=1)
    tau = sosfiltfilt(sos, torque, axis=1)
    return Y[:, trim:-trim:keep], tau[:, trim:-trim:keep]
