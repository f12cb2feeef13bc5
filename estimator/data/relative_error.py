"""Error of a prediction relative to the predicted motion."""

import numpy as np

from hil.estimator.arrays import Array


def relative_error(measured: Array, predicted: Array, noise: Array | None = None) -> Array:
    """Return the RMS of `measured` minus `predicted`, divided by the RMS of the motion about its mean (joints,).

    Both are positions (joints, samples) [rad]; samples that are NaN in `measured` are ignored. noise: standard
    deviation of one measured sample (joints,) [rad]; no model predicts it, so its power is subtracted.
    """
    motion = measured - np.nanmean(measured, axis=1, keepdims=True)
    square = np.nanmean((measured - predicted) ** 2, axis=1)
    if noise is not None:
        square = np.maximum(square - noise**2, 0.0)
    ratio: Array = np.sqrt(square / np.nanmean(motion**2, axis=1))
    return ratio
