"""Progress of long computations, reported to a callback."""

from collections.abc import Callable

__all__ = ["Tell", "counted"]

Tell = Callable[[int, int], None]
"""Called with the number of steps done and the total."""


def counted(tell: Tell | None, total: int) -> Callable[[], None]:
    """Return a function to call after each of `total` steps; it reports the number of steps done to `tell`."""
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if tell is not None:
            tell(done, total)

    return step
