"""Joints that stick and break away during a motion."""

import numpy as np

from hil.estimator.arrays import Array

STANDS_S = 0.4
"""A joint sticks if its reading stays the same for this time [s], which is longer than at the reversals of a usual
path.
"""
SAME_STEPS = 1.5  # encoder steps within which a reading counts as the same


def sticking_joints(position: Array, rate: float, step: Array) -> tuple[int, ...]:
    """Return the joints, numbered from 0, that stand still for `STANDS_S` during the motion.

    position: (joints, samples) [rad]; step: encoder steps (joints,) [rad]; rate: sample rate [1/s].
    """
    window = max(2, round(STANDS_S * rate))
    if position.shape[1] < window:
        return ()
    part = np.lib.stride_tricks.sliding_window_view(position, window, axis=1)
    with np.errstate(invalid="ignore"):
        least = (part.max(axis=2) - part.min(axis=2)).min(axis=1, initial=np.inf, where=~np.isnan(part).any(axis=2))
    return tuple(np.flatnonzero(least < SAME_STEPS * step).tolist())
