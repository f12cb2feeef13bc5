"""Clocks, which are passed to everything that waits.

The in-process fake bus has its own clock, on which sleeping takes no real time; see `hil.fakes.bus.clock`.
"""

import time
from typing import Protocol

SPIN_S = 300e-6
"""How long before a deadline the wall clock stops sleeping and spins instead [s]; a sleep can overrun by 0.2 ms."""


class Clock(Protocol):
    """A monotonic clock, in seconds, that can wait until a given time."""

    def now(self) -> float:
        """Return the seconds since an arbitrary start; the value never decreases."""
        ...

    def wait_until(self, deadline: float) -> None:
        """Wait until `deadline` [s, on this clock]; return immediately if it has passed."""
        ...


class WallClock:
    """The machine's monotonic clock. Sleeps until just before the deadline, then spins."""

    now = staticmethod(time.perf_counter)  # not wrapped in a method: it is called twice per cycle

    def wait_until(self, deadline: float) -> None:
        remaining = deadline - time.perf_counter()
        if remaining > SPIN_S:
            time.sleep(remaining - SPIN_S)
        while time.perf_counter() < deadline:
            pass
