"""Whether an arm has settled: how far successive periods of a periodic experiment still differ."""

from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array
from estimator.errors import ShapeError


@dataclass(frozen=True)
class Settling:
    """RMS difference of each period from the one before."""

    difference: Array
    """(periods - 1, joints) [rad]."""
    relative: Array
    """The same over the RMS of the later period's motion about its mean (periods - 1, joints)."""


def period_difference(position: Array) -> Settling:
    """Compare each period of `position` (periods, joints, samples) [rad] with the one before.

    Missing samples are NaN and left out of both. Raises ShapeError for fewer than two periods.
    """
    if position.ndim != 3 or position.shape[0] < 2:
        raise ShapeError(f"position is {position.shape}: it must be (periods, joints, samples), two periods or more")
    difference = np.sqrt(np.nanmean(np.diff(position, axis=0) ** 2, axis=2))
    motion = np.nanstd(position[1:], axis=2)
    still = np.where(difference > 0.0, np.inf, 0.0)
    relative = np.divide(difference, motion, out=still, where=motion > 0.0)
    return Settling(difference, relative)
