"""Schedule of the cycles that read slow registers or the status instead of the usual span."""

__all__ = ["NEVER", "Turns"]

NEVER = 1 << 62
"""A number of cycles that is never reached."""


class Turns:
    """Counts cycles until a span other than the usual one is due.

    `plan` returns the number of cycles until then, in which the usual span is read. To save time, the caller merely
    decrements this number in each cycle; `count` derives from it how many cycles have passed.

    slow_spans: number of slow spans. slow_every: samples between two slow reads. status_every: cycles between two
    status reads.
    """

    def __init__(self, slow_spans: int, slow_every: int, status_every: int) -> None:
        self._slow_spans = slow_spans
        self._slow_every = self._until_slow = slow_every
        self._status_every = self._until_status = status_every
        self._slow = 0
        self.usual = 0
        """Number of planned cycles with the usual span that have not yet been counted."""
        self.between = 0
        """Number of cycles since the previous sample that have not yet been counted."""

    def count(self, left: int) -> None:
        """Count the cycles run so far. left: number of planned cycles not yet run; -1 if one too many has been run."""
        passed = self.usual - left
        self._until_status -= passed
        self._until_slow -= passed - self.between
        self.usual, self.between = left, 0

    def due(self, between: bool) -> int:
        """Return the span to read now; 0 is the usual one. All cycles, including this one, must have been counted."""
        if self._until_slow <= 0 and not between:
            self._until_slow = self._slow_every
            # If a status is due as well, it waits for the next cycle, so that the two long reads never coincide.
            return self._next_slow()
        if self._until_status > 0:
            return 0
        self._until_status = self._status_every
        return 1 + self._slow_spans

    def _next_slow(self) -> int:
        if not self._slow_spans:
            return 0
        self._slow = self._slow % self._slow_spans + 1
        return self._slow

    def read_status_next(self) -> None:
        if self._status_every < NEVER:
            self._until_status = min(self._until_status, 1)

    def plan(self) -> int:
        """Return the minimum number of cycles before another span is due. Cycles between samples may add to this."""
        self.usual = max(0, min(self._until_slow, self._until_status) - 1)
        return self.usual
