"""Comparison of successive periods sample by sample, which avoids a burst of work at the end of a period.

The difference is that of `hil.estimator.data.periodicity.settling_difference`, accumulated during the period:
at its end only a few divisions remain. The previous period is kept in one buffer, which the latest one overwrites.

The same torque must cause the same motion. From the third period on, each sample is therefore compared with the same
sample of the previous period. If they differ by more than `TIMES` the RMS difference between the two previous periods,
plus `FLOOR_RAD`, for `LASTING_S`, the joint does not repeat its motion (`unlike`).
"""

from array import array
from collections.abc import Sequence
from math import inf, isnan, sqrt

_EMPTY = float("nan")

TIMES = 10.0
FLOOR_RAD = 0.05
"""Deviation from the previous period that is always accepted, because stiction may end slightly earlier or later."""

LASTING_S = 0.03
_FEWEST = 2  # samples, however low the rate


class Repetition:
    """Compares the positions of a period of up to `samples` samples with those of the period before.

    interval: time between samples [s].
    """

    def __init__(self, samples: int, joints: int, interval: float) -> None:
        self._half = 0
        self._lasting = max(_FEWEST, round(LASTING_S / interval))
        self._sums: list[_Sums] = [_Sums() for _ in range(joints)]
        self._former = [array("d", [_EMPTY]) * samples for _ in range(joints)]
        self.begin(samples, anew=True)

    def begin(self, samples: int, *, anew: bool = False) -> None:
        """Start a new period of `samples` samples. anew: whether its torque differs from the previous period's.

        The buffer is not cleared, which would take too long between two samples.
        """
        self._anew = anew
        self._half = samples // 2
        self._allowed = [inf if anew else TIMES * sums.rms_change + FLOOR_RAD for sums in self._sums]
        self._unlike_for = [0] * len(self._former)
        self._sums = [_Sums() for _ in self._former]

    def add(self, index: int, position: Sequence[float]) -> None:
        """Add sample `index` of the period: positions of all joints [rad], NaN where missing."""
        compared = index >= self._half
        for joint, (former, sums, latest) in enumerate(zip(self._former, self._sums, position, strict=True)):
            if not isnan(latest):
                # False where the former sample is missing, as every comparison with NaN is.
                self._unlike_for[joint] = (
                    self._unlike_for[joint] + 1 if abs(latest - former[index]) > self._allowed[joint] else 0
                )
                if latest < sums.lowest:
                    sums.lowest = latest
                if latest > sums.highest:
                    sums.highest = latest
                if compared:
                    sums.add(_EMPTY if self._anew else former[index], latest)
            former[index] = latest

    @property
    def unlike(self) -> int | None:
        """Index of a joint that does not repeat the motion of the period before, or None."""
        longest = max(self._unlike_for)
        return self._unlike_for.index(longest) if longest >= self._lasting else None

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
    def rms_change(self) -> float:
        """RMS difference from the period before [rad]; infinite if there was none to compare with."""
        return sqrt(self._squared / self._pairs) if self._pairs else inf

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
