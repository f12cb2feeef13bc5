"""One joint of the arm: which servo moves it, and how its ticks become SI units."""

import math
from dataclasses import dataclass

from drivers.servo_model import VELOCITY_UNIT, ServoModel


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint and its servo.

    direction: +1 or -1, the joint's sense of rotation against the servo's.
    zero_ticks: Present Position at which the joint's angle is zero.
    """

    name: str
    id: int
    servo: ServoModel
    direction: int = 1
    zero_ticks: int = 0

    @property
    def position_unit(self) -> float:
        """rad of joint angle per tick, with the joint's sign."""
        return self.direction * self.servo.position_unit

    @property
    def velocity_unit(self) -> float:
        """rad/s of joint velocity per tick, with the joint's sign."""
        return self.direction * VELOCITY_UNIT

    @property
    def current_unit(self) -> float:
        """A per tick, with the joint's sign."""
        return self.direction * self.servo.current_unit

    def angle(self, position_ticks: int) -> float:
        """Joint angle [rad] of a Present Position."""
        return (position_ticks - self.zero_ticks) * self.position_unit

    def current_ticks(self, current: float) -> int:
        """The Goal Current nearest to `current` [A]."""
        if not math.isfinite(current):
            raise ValueError(f"{self} was given a goal current of {current}, which is no number.")
        return round(current / self.current_unit)

    def __str__(self) -> str:
        return f"joint {self.name!r} (ID {self.id}, {self.servo.name})"
