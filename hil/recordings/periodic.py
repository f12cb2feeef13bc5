"""Reduction of a recording with periodic torque to the mean period of its settled part, which saves simulation time and
averages out noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording

EVEN = 0.02  # largest deviation of the sample times from equal spacing, as a fraction of an interval
SHORTEST = 64  # minimum number of samples in a period
SAME_TORQUE = 1e-3  # largest RMS difference, relative to the torque's RMS
SAME_MOTION = 0.02  # largest RMS difference, relative to the motion's RMS; as in the settling of `hil identify`


@dataclass(frozen=True)
class MeanPeriod:
    """A mean period. recording: mean of `periods` settled periods of `seconds` [s] each."""

    recording: Recording
    periods: int
    seconds: float


def mean_period(recording: Recording) -> MeanPeriod | None:
    """Mean period of the settled part; None if the torque is not periodic or the motion never settles."""
    interval = recording.interval
    step = np.diff(recording.time)
    if not np.all(np.abs(step - interval) < EVEN * interval):
        return None
    length = _period(recording.torque)
    if length is None:
        return None
    whole = recording.time.size // length
    first = recording.time.size - whole * length
    position = recording.position[:, first:].reshape(recording.joints, whole, length)
    settled = _settled(position, recording.noise)
    if settled < 2:
        return None
    with np.errstate(invalid="ignore"):
        mean = np.nanmean(position[:, -settled:], axis=1)
    torque = recording.torque[:, first:].reshape(recording.joints, whole, length)[:, -settled:].mean(axis=1)
    time = recording.time[-length:] - recording.time[-length]
    averaged = Recording(time, torque, mean, recording.position_step, recording.between, recording.command_to_sample)
    return MeanPeriod(averaged, settled, length * interval)


def _period(torque: Array) -> int | None:
    """Period, in samples, of the torque (joints, samples), which must hold at least two periods; None if it is not
    periodic.
    """
    moved = torque - torque.mean(axis=1, keepdims=True)
    samples = moved.shape[1]
    power = float(np.mean(moved**2))
    if samples < 2 * SHORTEST or power == 0.0:
        return None
    lines = np.fft.rfft(moved, 2 * samples, axis=1)
    alike = np.fft.irfft(np.abs(lines) ** 2, axis=1)[:, :samples].sum(axis=0)
    alike /= np.arange(samples, 0, -1) * power * len(moved)
    most = samples // 2
    candidates: NDArray[np.int64] = SHORTEST + np.flatnonzero(alike[SHORTEST : most + 1] > 0.9)
    for lag in candidates.tolist():
        # The recording may begin with a ramp, so only the last two periods are compared.
        latest, former = moved[:, -lag:], moved[:, -2 * lag : -lag]
        if float(np.mean((latest - former) ** 2)) < SAME_TORQUE**2 * power:
            return int(lag)
    return None


def _settled(position: Array, noise: Array) -> int:
    """Number of periods at the end that repeat the same motion. position: (joints, periods, samples)."""
    count = 1
    motion = np.nanstd(position[:, -1], axis=1)
    for latest in range(position.shape[1] - 1, 0, -1):
        difference = np.sqrt(np.nanmean((position[:, latest] - position[:, latest - 1]) ** 2, axis=1))
        if np.any(difference > SAME_MOTION * motion + 3.0 * noise):
            break
        count += 1
    return count
