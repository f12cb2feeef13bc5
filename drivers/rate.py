"""A fixed rate based on absolute deadlines: a late cycle does not delay later ones."""

from functools import partial
from typing import NamedTuple

from hil.drivers.clock import Clock

__all__ = ["FixedRate", "Tick"]


class Tick(NamedTuple):
    """One deadline of a fixed rate.

    deadline: when the wait should have ended [s, on the clock].
    now: when it ended [s].
    missed: whether the wait ended at least one whole interval late; if so, the caller should skip this sample.
    """

    deadline: float
    now: float
    missed: bool


_tick = partial(tuple.__new__, Tick)  # half the time of Tick(...)


class FixedRate:
    """Deadlines that occur `rate` times per second, beginning one interval after the first call of `wait`.

    After a stall, each missed deadline is returned without waiting, marked as missed and counted in `missed`.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self._interval = 1 / rate
        self._start: float | None = None
        self._index = 0
        self.missed = 0

    def wait(self) -> Tick:
        if self._start is None:
            self._start = self._clock.now() + self._interval
        deadline = self._start + self._index * self._interval
        self._index += 1
        self._clock.wait_until(deadline)
        now = self._clock.now()
        missed = now - deadline >= self._interval
        self.missed += missed
        return _tick((deadline, now, missed))
