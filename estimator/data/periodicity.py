"""Differences between successive periods of a periodic experiment, which show whether the arm has settled."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ShapeError

EVEN = 1.1  # maximum ratio of successive changes in a decreasing sequence
SLOWEST = 0.97  # mean ratio of successive changes up to which they count as decreasing
SLOWLY = 0.65  # minimum ratio of successive changes while friction warms up, which takes many periods
WARMEST = 0.25  # largest change from period to period while friction warms up
ALIKE = (
    0.8  # minimum correlation of successive changes while friction warms up, as it always changes in the same direction
)
MOST_PERIODS = 100  # largest number of periods to recommend


@dataclass(frozen=True)
class Settling:
    """RMS difference between each period and the previous one."""

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
    """Return the RMS difference between a period (joints, samples) [rad] and the previous one, relative to the motion's
    RMS.

    The value is that of the worst joint. Only the second halves are compared. If they agree, the latest period is
    settled as a whole, even if the previous one began with the transient of the ramp.
    """
    half = former.shape[1] // 2
    return float(period_difference(np.stack([former, latest])[:, :, half:]).relative.max())


@dataclass(frozen=True)
class Decay:
    """A change from period to period that decreases by about the same factor each time.

    ratio: factor between successive changes. further: number of further periods until the change is within tolerance.
    """

    ratio: float
    further: int

    def is_drift(self, correlation: float) -> bool:
        """Return whether the change looks like a drift of friction or torque rather than a transient.

        A drift changes the motion in the same direction for many periods; a transient oscillates or decays faster.
        correlation: see `correlation_of_changes`.
        """
        return self.ratio >= SLOWLY and correlation >= ALIKE


def decay_of(differences: Sequence[float], within: float) -> Decay | None:
    """Return the decay of the relative differences between successive periods, and the number of periods it takes to
    reach `within`.

    Returns None if the differences do not decrease steadily.

    differences: in chronological order; the first may contain the transient of the ramp.
    """
    falling = list(differences[1:])
    if len(falling) < 2 or not all(math.isfinite(each) and each > 0.0 for each in differences):
        return None
    if any(later > EVEN * former for former, later in itertools.pairwise(differences)):
        return None
    ratio = (falling[-1] / falling[0]) ** (1.0 / (len(falling) - 1))
    if not ratio <= SLOWEST:
        return None
    further = max(1, math.ceil(math.log(within / falling[-1]) / math.log(ratio)))
    return Decay(ratio, further) if len(differences) + further <= MOST_PERIODS else None


def correlation_of_changes(position: Array) -> float:
    """Return the correlation of a period's change with the previous change; -1 for opposite changes.

    position: the three latest periods (3, joints, samples) [rad]. Only the joint whose motion changes most, relative to
    that motion, is considered. As in `settling_difference`, only the second halves are compared. The result is NaN if
    nothing can be compared.
    """
    half = position[:, :, position.shape[2] // 2 :]
    changes = np.diff(half, axis=0)
    joint = int(np.argmax(period_difference(half).relative[-1]))
    former, latest = changes[0, joint], changes[1, joint]
    seen = np.isfinite(former) & np.isfinite(latest)
    size = math.sqrt(float(np.sum(former[seen] ** 2)) * float(np.sum(latest[seen] ** 2)))
    return float(np.sum(former[seen] * latest[seen])) / size if size else math.nan


def _rms(values: Array) -> Array:
    """Return the RMS over the last axis, ignoring NaN; infinite if all values are NaN."""
    seen = np.isfinite(values)
    count = seen.sum(axis=-1)
    total = np.sum(np.where(seen, values, 0.0) ** 2, axis=-1)
    nothing = np.full(total.shape, np.inf)
    return np.asarray(np.sqrt(np.divide(total, count, out=nothing, where=count > 0)))
