"""What moves behind the fake servos: the one interface a plant needs to stand there."""

from collections.abc import Sequence
from typing import Protocol


class Plant(Protocol):
    """A mechanism with one motor per joint, advanced lazily by the bus in the bus's own time.

    Angles and velocities are those of the servos' output shafts: joint 1 from the horizontal, joint 2 relative to
    link 1 (two-link arm). `current` is what really flows in each motor, after its current loop's lag.
    """

    @property
    def joints(self) -> int: ...

    @property
    def position(self) -> Sequence[float]:
        """Joint angles [rad]."""
        ...

    @property
    def velocity(self) -> Sequence[float]:
        """Joint velocities [rad/s]."""
        ...

    @property
    def current(self) -> Sequence[float]:
        """Motor currents [A]."""
        ...

    def advance(self, until: float, current: Sequence[float]) -> None:
        """Move on to time `until` [s] with the commanded motor currents [A] held constant from the present time on.

        Returns at once when `until` is not later than the plant's present time.
        """
        ...
