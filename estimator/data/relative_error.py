"""Error of a prediction relative to the motion that it predicts."""

import numpy as np

from hil.estimator.arrays import Array


def relative_error(measured: Array, predicted: Array) -> Array:
    """Return the RMS of `measured` minus `predicted` over that of the motion about its mean (joints,).

    Both are positions (joints, samples) [rad]; samples that are NaN in `measured` do not count.
    """
    motion = measured - np.nanmean(measured, axis=1, keepdims=True)
    ratio: Array = np.sqrt(np.nanmean((measured - predicted) ** 2, axis=1) / np.nanmean(motion**2, axis=1))
    return ratio
