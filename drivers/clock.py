"""Time as a parameter: everything that waits takes a Clock.

The in-process fake bus has its own clock, on which sleeping costs nothing; see `hil.fakes.bus.clock`.
"""

import time
from typing import Protocol

SPIN_S = 300e-6
"""How long before a deadline the wall clock stops sleeping and spins. Sleeping wakes up to 0.2 ms late."""


class Clock(Protocol):
    """Monotonic time in seconds, and the means to wait for it."""

    def now(self) -> float:
        """Seconds since an arbitrary start, never going back."""
        ...

    def wait_until(self, deadline: float) -> None:
        """Return at `deadline` [s, on this clock], or at once when it has passed."""
        ...


class WallClock:
    """The machine's monotonic clock. Sleeps to just before the deadline, then spins."""

    now = staticmethod(time.perf_counter)  # itself, not a call around it: it is asked twice a cycle

    def wait_until(self, deadline: float) -> None:
        remaining = deadline - time.perf_counter()
        if remaining > SPIN_S:
            time.sleep(remaining - SPIN_S)
        while time.perf_counter() < deadline:
            pass
