"""Whether an arm has settled: the difference between successive periods of a periodic experiment."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ShapeError

EVEN = 1.1  # maximum ratio of successive changes in a decreasing sequence
SLOWLY = 0.4, 0.97  # mean ratio of successive changes of a slow drift; smaller for a transient, larger for others


@dataclass(frozen=True)
class Settling:
    """RMS difference of each period from the previous one."""

    difference: Array
    """RMS difference (periods - 1, joints) [rad]."""
    relative: Array
    """RMS difference relative to the RMS of the later period's motion about its mean (periods - 1, joints)."""


def period_difference(position: Array) -> Settling:
    """Compare each period of `position` (periods, joints, samples) [rad] with the previous one.

    Samples missing (NaN) in either period are ignored; for a joint with no samples to compare, the difference is
    infinite. Raises ShapeError for fewer than two periods.
    """
    if position.ndim != 3 or position.shape[0] < 2:
        raise ShapeError(f"position has shape {position.shape}; it must be (at least 2 periods, joints, samples)")
    difference = _rms(np.diff(position, axis=0))
    later = position[1:]
    seen = np.isfinite(later)
    mean = np.where(seen, later, 0.0).sum(axis=2) / np.maximum(seen.sum(axis=2), 1)
    motion = _rms(later - mean[:, :, None])
    still = np.where(difference > 0.0, np.inf, 0.0)
    relative = np.divide(difference, motion, out=still, where=(motion > 0.0) & np.isfinite(motion))
    return Settling(difference, relative)


def settling_difference(former: Array, latest: Array) -> float:
    """Return the RMS difference of a period (joints, samples) [rad] from the previous one, relative to the motion.

    The worst joint counts. Only the second halves are compared. If they agree, the motion had settled before the end of
    the previous period. The latest one is then settled as a whole, even if the previous one began with the transient of
    the ramp. This saves a whole period of the experiment.
    """
    half = former.shape[1] // 2
    return float(period_difference(np.stack([former, latest])[:, :, half:]).relative.max())


def periods_of_drift(differences: Sequence[float], within: float) -> int | None:
    """Return how many more periods of slow drift it takes until successive periods differ by at most `within`.

    As grease warms up, the change from period to period decreases slowly and steadily. None if the changes do not look
    like that: backlash or a dragging cable make them irregular, and a transient dies out faster.

    differences: relative differences of successive periods, in the order of time; the first may contain a transient.
    """
    falling = list(differences[1:])
    if len(falling) < 2 or not all(math.isfinite(each) and each > 0.0 for each in falling):
        return None
    if any(later > EVEN * former for former, later in itertools.pairwise(falling)):
        return None
    ratio = (falling[-1] / falling[0]) ** (1.0 / (len(falling) - 1))
    if not SLOWLY[0] <= ratio <= SLOWLY[1]:
        return None
    return max(1, math.ceil(math.log(within / falling[-1]) / math.log(ratio)))


def _rms(values: Array) -> Array:
    """Return the RMS over the last axis, ignoring NaN; infinite if nothing is left."""
    seen = np.isfinite(values)
    count = seen.sum(axis=-1)
    total = np.sum(np.where(seen, values, 0.0) ** 2, axis=-1)
    nothing = np.full(total.shape, np.inf)
    return np.asarray(np.sqrt(np.divide(total, count, out=nothing, where=count > 0)))
