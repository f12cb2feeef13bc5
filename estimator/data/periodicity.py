"""Whether an arm has settled: the difference between successive periods of a periodic experiment."""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ShapeError


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

    The worst joint counts. Only the second halves are compared: if they agree, the previous period ended settled, so
    the whole latest one is settled even if the previous one began with the transient of the ramp. This saves a whole
    period of arm time.
    """
    half = former.shape[1] // 2
    return float(period_difference(np.stack([former, latest])[:, :, half:]).relative.max())


def _rms(values: Array) -> Array:
    """Return the RMS over the last axis, ignoring NaN; infinite if nothing is left."""
    seen = np.isfinite(values)
    count = seen.sum(axis=-1)
    total = np.sum(np.where(seen, values, 0.0) ** 2, axis=-1)
    nothing = np.full(total.shape, np.inf)
    return np.asarray(np.sqrt(np.divide(total, count, out=nothing, where=count > 0)))
