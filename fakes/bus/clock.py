"""Virtual time, for a fake arm on which nothing outside the process depends."""


class VirtualClock:
    """A `hil.drivers.clock.Clock` that stands still while the program computes and jumps when it waits.

    A run on this clock is deterministic.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now

    def wait_until(self, deadline: float) -> None:
        """Jump to `deadline` [s]; do nothing if it has passed."""
        if deadline > self._now:
            self._now = deadline
