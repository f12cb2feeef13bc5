"""One joint of the arm: which servos move it, and how their ticks convert to SI units."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from hil.drivers.servo_model import FULL_PWM_TICKS, VELOCITY_UNIT, Mode, ServoModel

__all__ = ["Joint", "SecondServo"]


class SecondServo(NamedTuple):
    """An additional servo on a joint.

    id: the servo's bus ID.
    direction: +1 or -1, the joint's sense of rotation relative to this servo's.
    """

    id: int
    direction: int


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint and its servos.

    direction: +1 or -1, the joint's sense of rotation relative to the servo's.
    zero_ticks: Present Position at joint angle zero.
    mode: kind of goal, a current [A] or a voltage [V]. Raises ValueError if the servo does not support this mode.
    near: approximate joint angle when the bus is opened [rad], which selects the turn; None to use Present Position
    unchanged.
    seconds: additional servos of the same model on this joint. A goal is divided equally among all servos; measured
    currents (in PWM mode, voltages) are summed; angle and velocity are the first servo's.
    """

    name: str
    id: int
    servo: ServoModel
    direction: int = 1
    zero_ticks: int = 0
    mode: Mode = Mode.CURRENT
    near: float | None = None
    seconds: tuple[SecondServo, ...] = ()

    def __post_init__(self) -> None:
        if self.mode is Mode.CURRENT and self.servo.current_unit is None:
            raise ValueError(f"{self} has no current mode; drive it in PWM mode.")

    @property
    def drives(self) -> tuple["Joint", ...]:
        """Single-servo joints that together represent this joint, one per servo."""
        first = replace(self, seconds=())
        return first, *[replace(first, id=servo_id, direction=sign, near=None) for servo_id, sign in self.seconds]

    @property
    def position_unit(self) -> float:
        """Joint angle per tick [rad], with the joint's sign."""
        return self.direction * self.servo.position_unit

    @property
    def velocity_unit(self) -> float:
        """Joint velocity per tick [rad/s], with the joint's sign."""
        return self.direction * VELOCITY_UNIT

    def drive_unit(self, supply_voltage: float) -> float:
        """Return the current or voltage per tick of the goal and of the measured value, with the joint's sign.

        The unit is A or V, depending on `mode`. supply_voltage: voltage applied at a PWM of 885 ticks [V].
        """
        if self.mode is Mode.CURRENT:
            assert self.servo.current_unit is not None  # checked in __post_init__
            return self.direction * self.servo.current_unit
        return self.direction * supply_voltage / FULL_PWM_TICKS

    def current_limit_ticks(self, limit: float) -> int:
        """Return the lowest Current Limit [ticks] at which this joint's servos accept all goals up to `limit` [A]."""
        return math.ceil(limit / abs(self.drive_unit(0.0)) - 1e-9)

    def angle(self, position_ticks: int) -> float:
        """Return the joint angle [rad] for a value of Present Position [ticks]."""
        return (position_ticks - self.zero_ticks) * self.position_unit

    def within_turn(self, position_ticks: int) -> "Joint":
        """Return this joint with its zero shifted by whole turns, so that its angle is closest to `near`.

        Without `near`, the joint is returned unchanged. After power-up, a servo reports its position within a single
        turn; if the joint rests just beyond the end of that turn, its angle is off by a whole turn.
        """
        if self.near is None:
            return self
        turns = round((self.angle(position_ticks) - self.near) / math.tau)
        return replace(self, zero_ticks=self.zero_ticks + self.direction * turns * self.servo.position_steps)

    @property
    def title(self) -> str:
        """The joint's name, capitalised for the beginning of a sentence."""
        text = str(self)
        return text[0].upper() + text[1:]

    def __str__(self) -> str:
        ids = "".join(f" and {second.id}" for second in self.seconds)
        return f"joint {self.name!r} (ID{'s' if ids else ''} {self.id}{ids}, {self.servo.name})"
