"""Compare successive periods sample by sample. This avoids a burst of work at the end of a period.

Differences are measured as in `hil.estimator.data.periodicity.settling_difference`, but accumulated during the period.

The same torque must cause the same motion. From the third period on, each sample is therefore compared with the same
sample of the previous period. If they differ by more than `TIMES` times the RMS difference between the two previous
periods, plus `FLOOR_RAD`, for `LASTING_S`, the joint does not repeat its motion (`unlike`). In the second half of the
second period, the RMS difference in its first half is used instead, since transients only decay. A disturbance in the
last `UNJUDGED_S` of a period must not enlarge the tolerance in the next one.
"""

from collections.abc import Callable, Sequence
from math import inf, sqrt
from struct import Struct
from typing import Any

import numpy as np

from hil.estimator.compiled import compiled, only_version

_EMPTY = float("nan")

TIMES = 10.0
FLOOR_RAD = 0.05
"""Deviation from the previous period that is always accepted [rad], because stiction may end slightly earlier or later.
"""

LASTING_S = 0.03
UNJUDGED_S, _MOST_UNJUDGED = 0.2, 0.25
"""Duration of the part at the end of a period that does not affect the tolerance in the next one [s], and its upper
bound, as a fraction of the period.
"""

_FEWEST = 2  # samples, however low the rate


_EARLY = "early_squared", "early_pairs"
_SUMS = np.dtype(
    [
        (name, "f8")
        for names in (
            ("lowest", "highest", "first", "squared", "sum", "sum_of_squares", "pairs", "seen"),
            _EARLY,
            ("sure_squared", "sure_pairs"),
        )
        for name in names
    ]
)
"""Running sums of one joint.

lowest, highest: range of its positions [rad]. first: first position in the second half of the period. sum,
sum_of_squares, seen: sum, sum of squares and number of the positions in that half, relative to `first` to avoid
cancellation. squared, pairs: sum of squares and number of their changes from the previous period. early_squared,
early_pairs: `squared` and `pairs` for the first half. sure_squared, sure_pairs: the same for the second half without
its end.
"""


class Repetition:
    """Compares the positions in a period of up to `samples` samples with those in the previous period.

    interval: time between samples [s].
    """

    def __init__(self, samples: int, joints: int, interval: float) -> None:
        self._unjudged = round(UNJUDGED_S / interval)
        self._lasting = max(_FEWEST, round(LASTING_S / interval))
        self._sums = np.zeros(joints, _SUMS)
        self._former = np.full((joints, samples), np.nan)
        self._latest = np.full(joints, np.nan)
        self._pack = Struct(f"{joints}d").pack_into
        self._bytes = memoryview(self._latest.data).cast("B")
        self.begin(samples)
        _add(self._former, self._sums, self._allowed, self._unlike_for, self._latest, 0, False, False, True)  # compile
        self._compare = only_version(_add)

    def begin(self, samples: int, *, anew: bool = False) -> None:
        """Start a new period of `samples` samples. anew: whether its torque differs from the previous period's.

        The buffer is not cleared: that would take too long between two samples.
        """
        self._anew = anew
        self._half = samples // 2
        self._sure = samples - min(self._unjudged, int(_MOST_UNJUDGED * samples))
        self._allowed = np.array([inf if anew else TIMES * _rms_change(sums) + FLOOR_RAD for sums in self._sums])
        self._unlike_for = np.zeros(len(self._sums), np.int64)
        self._sums = np.zeros(len(self._sums), _SUMS)
        self._sums["lowest"], self._sums["highest"] = inf, -inf
        self.unlike: int | None = None
        """Index of a joint that does not repeat the previous period's motion, or None."""

    def add(self, index: int, position: Sequence[float]) -> None:
        """Add sample `index` of the period: positions of all joints [rad], NaN where missing."""
        self._pack(self._bytes, 0, *position)
        compared, sure = index >= self._half, index < self._sure
        joint = self._compare(
            self._former, self._sums, self._allowed, self._unlike_for, self._latest, index, compared, sure, self._anew
        )
        self.unlike = joint if self._unlike_for[joint] >= self._lasting else None

    @property
    def moved(self) -> list[float]:
        """Range of each joint's positions in this period (joints,) [rad]; NaN if no reply was received."""
        return [
            float(sums["highest"] - sums["lowest"]) if sums["highest"] >= sums["lowest"] else _EMPTY
            for sums in self._sums
        ]

    @property
    def difference(self) -> float:
        """RMS difference between the second halves of the periods, relative to the RMS of the motion, for the worst
        joint.
        """
        return max(map(_relative, self._sums))

    @property
    def worst(self) -> int:
        """Index of the joint whose motion differs most."""
        return int(np.argmax([_relative(sums) for sums in self._sums]))


def _rms_change(sums: Any) -> float:
    """RMS difference from the previous period, except at the end [rad]; infinite if there is no previous period."""
    return sqrt(sums["sure_squared"] / sums["sure_pairs"]) if sums["sure_pairs"] else inf


def _relative(sums: Any) -> float:
    """RMS difference from the previous period, relative to the RMS of the motion."""
    if not sums["pairs"]:
        return inf
    mean = sums["sum"] / sums["seen"]
    motion = sums["sum_of_squares"] / sums["seen"] - mean * mean
    changed = sums["squared"] / sums["pairs"]
    if motion <= 0.0:
        return inf if changed > 0.0 else 0.0
    return sqrt(changed / motion)


def _add_loop(
    former: Any,
    all_sums: Any,
    allowed: Any,
    unlike_for: Any,
    position: Any,
    index: int,
    compared: bool,
    sure: bool,
    anew: bool,
) -> int:
    """Add one sample; return the joint that has differed from the previous period for the longest time."""
    longest = 0
    for joint in range(len(position)):
        sums, latest, before = all_sums[joint], position[joint], former[joint, index]
        if not np.isnan(latest):
            # False where the former sample is missing, as every comparison with NaN is.
            unlike_for[joint] = unlike_for[joint] + 1 if abs(latest - before) > allowed[joint] else 0
            if not (compared or anew or np.isnan(before)):
                sums.early_pairs += 1.0
                sums.early_squared += (latest - before) * (latest - before)
            elif compared and sums.early_pairs > 0.0 and allowed[joint] == inf:
                allowed[joint] = TIMES * sqrt(sums.early_squared / sums.early_pairs) + FLOOR_RAD
            sums.lowest = min(sums.lowest, latest)
            sums.highest = max(sums.highest, latest)
            if compared:
                if sums.seen == 0.0:
                    sums.first = latest
                from_first = latest - sums.first
                sums.seen += 1.0
                sums.sum += from_first
                sums.sum_of_squares += from_first * from_first
                if not (anew or np.isnan(before)):
                    change = latest - before
                    sums.pairs += 1.0
                    sums.squared += change * change
                    if sure:
                        sums.sure_pairs += 1.0
                        sums.sure_squared += change * change
        former[joint, index] = latest
        if unlike_for[joint] > unlike_for[longest]:
            longest = joint
    return longest


_add: Callable[..., int] = compiled(_add_loop)
