"""Comparison of successive periods while they are played, which avoids a burst of work at the end of a period.

The difference is that of `hil.estimator.data.periodicity.settling_difference`, accumulated sample by sample: at the end
of a period only a few divisions remain. The previous period is kept in one buffer, which the latest one overwrites.
"""

from array import array
from collections.abc import Sequence
from math import inf, isnan, sqrt

_EMPTY = float("nan")


class Repetition:
    """Compares the positions of a period of up to `samples` samples with those of the period before."""

    def __init__(self, samples: int, joints: int) -> None:
        self._half = 0
        self._former = [array("d", [_EMPTY]) * samples for _ in range(joints)]
        self.begin(samples)

    def begin(self, samples: int) -> None:
        """Start a new period of `samples` samples."""
        self._half = samples // 2
        self._sums = [_Sums() for _ in self._former]

    def add(self, index: int, position: Sequence[float]) -> None:
        """Add sample `index` of the period: positions of all joints [rad], NaN where missing."""
        compared = index >= self._half
        for former, sums, latest in zip(self._former, self._sums, position, strict=True):
            if not isnan(latest):
                sums.lowest = min(sums.lowest, latest)
                sums.highest = max(sums.highest, latest)
                if compared:
                    sums.add(former[index], latest)
            former[index] = latest

    @property
    def moved(self) -> list[float]:
        """Range of each joint's positions in this period (joints,) [rad]; NaN if no reply was received."""
        return [sums.highest - sums.lowest if sums.highest >= sums.lowest else _EMPTY for sums in self._sums]

    @property
    def difference(self) -> float:
        """RMS difference between the second halves of the periods, relative to the RMS of the motion; the worst
        joint's.
        """
        return max(sums.relative for sums in self._sums)


class _Sums:
    """Running sums of one joint."""

    __slots__ = ("_first", "_pairs", "_seen", "_squared", "_sum", "_sum_of_squares", "highest", "lowest")

    def __init__(self) -> None:
        self.lowest, self.highest = inf, -inf
        self._first = 0.0
        self._squared = self._sum = self._sum_of_squares = 0.0
        self._pairs = self._seen = 0

    def add(self, former: float, latest: float) -> None:
        if self._seen == 0:
            self._first = latest  # subtracting it avoids cancellation
        from_first = latest - self._first
        self._seen += 1
        self._sum += from_first
        self._sum_of_squares += from_first * from_first
        if not isnan(former):
            change = latest - former
            self._pairs += 1
            self._squared += change * change

    @property
    def relative(self) -> float:
        if not self._pairs:
            return inf
        mean = self._sum / self._seen
        motion = self._sum_of_squares / self._seen - mean * mean
        changed = self._squared / self._pairs
        if motion <= 0.0:
            return inf if changed > 0.0 else 0.0
        return sqrt(changed / motion)
