"""Estimation of an encoder's resolution from its readings."""

import numpy as np

from hil.estimator.arrays import Array

FEWEST = 5  # readings
MOST_OFF = 0.12  # largest distance from a reading to a whole step, in steps, to allow for values rounded in the file
MOST_SHARE = 0.7  # largest ratio of distinct values to readings at which steps are recognised


def encoder_step(position: Array) -> float | None:
    """Largest step that divides all differences between readings (samples,), in their unit; None if there is none."""
    finite = position[np.isfinite(position)]
    if finite.size < FEWEST:
        return None
    levels = np.unique(finite)
    apart = np.diff(levels)
    resolution = 1e-9 * max(1.0, float(np.abs(levels).max()))
    levels = levels[np.concatenate(([True], apart > resolution))]
    apart = np.diff(levels)
    if levels.size < 2 or levels.size > MOST_SHARE * finite.size:
        return None
    for guess in (float(np.median(apart)), float(np.min(apart))):
        step = _refined(levels - levels[0], guess)
        if step is not None:
            return step
    return None


def _refined(away: Array, step: float) -> float | None:
    """Refine a step by regression on whole numbers of steps, first with nearby readings, finally with all; None if too
    few readings are whole steps apart.
    """
    reach = 20.0 * step
    while True:
        near = away <= reach
        count = np.round(away[near] / step)
        total = float(count @ count)
        if total == 0.0:
            return None
        step = float(count @ away[near]) / total
        if near.all():
            break
        reach *= 4.0
    off = np.abs(away / step - np.round(away / step))
    return (
        step
        if float(np.mean(off > MOST_OFF)) < 0.01 and np.unique(np.round(away / step)).size > 0.9 * away.size
        else None
    )
