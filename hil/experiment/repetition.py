"""Successive periods compared as they are played, so that no burst of work is needed at the end of a period.

The difference is that of `hil.estimator.data.periodicity.settling_difference`, summed sample by sample: at the end of a
period only a few divisions are left. The former period lies in one buffer, which the latest one overwrites.
"""

from array import array
from collections.abc import Sequence
from math import inf, isnan, sqrt

_EMPTY = float("nan")


class Repetition:
    """Positions of a period, of at most `samples`, against those of the period before it."""

    def __init__(self, samples: int, joints: int) -> None:
        self._half = 0
        self._former = [array("d", [_EMPTY]) * samples for _ in range(joints)]
        self.begin(samples)

    def begin(self, samples: int) -> None:
        """A new period of so many samples starts."""
        self._half = samples // 2
        self._sums = [_Sums() for _ in self._former]

    def add(self, index: int, position: Sequence[float]) -> None:
        """Sample `index` of the period: positions of all joints [rad], NaN where missing."""
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
        """From the lowest to the highest position of this period (joints,) [rad]; NaN where no reply came."""
        return [sums.highest - sums.lowest if sums.highest >= sums.lowest else _EMPTY for sums in self._sums]

    @property
    def difference(self) -> float:
        """RMS difference of the later halves over the RMS of the motion, the worst joint."""
        return max(sums.relative for sums in self._sums)


class _Sums:
    """One joint's."""

    __slots__ = ("_first", "_pairs", "_seen", "_squared", "_sum", "_sum_of_squares", "highest", "lowest")

    def __init__(self) -> None:
        self.lowest, self.highest = inf, -inf
        self._first = 0.0
        self._squared = self._sum = self._sum_of_squares = 0.0
        self._pairs = self._seen = 0

    def add(self, former: float, latest: float) -> None:
        if self._seen == 0:
            self._first = latest  # sums of small numbers keep their digits
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
