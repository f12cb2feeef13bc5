"""Weights of position samples, based on each joint's noise level in a fit; outliers are downweighted (Huber)."""

from collections.abc import Sequence

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod

__all__ = ["noise_weights"]


def noise_weights(
    periods: Sequence[SettledPeriod], positions: Sequence[Array], threshold: float
) -> tuple[tuple[Array, ...], int]:
    """Estimate the noise level of each joint from its residuals and weight the samples accordingly.

    Args:
        periods: the measured periods.
        positions: the simulated positions of each period (joints, samples) [rad].
        threshold: residuals larger than this many standard deviations are downweighted.

    Returns:
        The weights of each period (joints, samples) [1/rad], 0 where a sample is missing, and the number of
        downweighted samples.
    """
    weights = []
    outliers = 0
    for period, position in zip(periods, positions, strict=True):
        error = np.where(period.valid, np.abs(period.position - position), 0.0)
        # The standard deviation is 1.15 times the median magnitude for rounding errors, and 1.48 times for normal
        # errors.
        typical = np.array([1.35 * np.median(row[valid]) for row, valid in zip(error, period.valid, strict=True)])
        spread = np.maximum(typical, period.noise)[:, None]
        far = error > threshold * spread
        weight = np.where(far, np.sqrt(threshold * spread / np.where(far, error, 1.0)), 1.0)
        inside = np.where(far | ~period.valid, np.nan, error)
        rms = np.sqrt(np.nanmean(inside**2, axis=1))[:, None]
        weights.append(np.where(period.valid, weight / np.maximum(rms, period.noise[:, None]), 0.0))
        outliers += int(far.sum())
    return tuple(weights), outliers
