"""Detection of values that this program cannot have written but reads from a servo too often for an accident."""

from collections import deque

__all__ = ["ForeignValues"]

ENOUGH, WITHIN_S = 3, 10.0
"""Number of foreign values, and the time [s] within which they must be read to prove that something else writes to the
servo or alters what is written.
"""


class ForeignValues:
    """The latest values read from one servo that this program cannot have written."""

    def __init__(self) -> None:
        self._at: deque[float] = deque(maxlen=ENOUGH)

    def add(self, now: float) -> None:
        """Record a value that this program cannot have written, read at `now` [s]."""
        self._at.append(now)

    def are_proof(self, now: float) -> bool:
        """Whether enough foreign values were read within WITHIN_S before `now` [s]."""
        return len(self._at) == ENOUGH and now - self._at[0] <= WITHIN_S
