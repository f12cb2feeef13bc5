"""One joint of the arm: which servo moves it, and how its ticks become SI units."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from hil.drivers.servo_model import FULL_PWM_TICKS, VELOCITY_UNIT, Mode, ServoModel


class SecondServo(NamedTuple):
    """Another servo on the same joint: its ID, and +1 or -1, the joint's sense of rotation against this servo's."""

    id: int
    direction: int


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint and its servo.

    direction: +1 or -1, the joint's sense of rotation against the servo's.
    zero_ticks: Present Position at which the joint's angle is zero.
    mode: what a goal is, a current [A] or a voltage [V]. Raises ValueError for a current that the servo does not have.
    near: about where the joint is when the bus is opened [rad], which determines its turn; None: as Present Position
    indicates.
    seconds: further servos of the same model on this joint. A goal is shared out between all of them, and the measured
    current (under PWM the voltage) is their sum; angle and velocity are the first one's.
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
        """One joint of a single servo for each of the servos."""
        first = replace(self, seconds=())
        return first, *[replace(first, id=servo_id, direction=sign, near=None) for servo_id, sign in self.seconds]

    @property
    def position_unit(self) -> float:
        """rad of joint angle per tick, with the joint's sign."""
        return self.direction * self.servo.position_unit

    @property
    def velocity_unit(self) -> float:
        """rad/s of joint velocity per tick, with the joint's sign."""
        return self.direction * VELOCITY_UNIT

    def drive_unit(self, supply_voltage: float) -> float:
        """A or V, as `mode` says, per tick of goal and of its measured counterpart, with the joint's sign.

        supply_voltage: V; a PWM of 885 ticks is all of it.
        """
        if self.mode is Mode.CURRENT:
            assert self.servo.current_unit is not None  # checked when the joint was made
            return self.direction * self.servo.current_unit
        return self.direction * supply_voltage / FULL_PWM_TICKS

    def angle(self, position_ticks: int) -> float:
        """Joint angle [rad] of a Present Position."""
        return (position_ticks - self.zero_ticks) * self.position_unit

    def within_turn(self, position_ticks: int) -> "Joint":
        """This joint with the zero of the turn in which it is `near`, where it is known, at this Present Position.

        A servo counts turns from where it was switched on: within one turn, and a joint that hangs just beyond the end
        of that turn starts a whole turn away.
        """
        if self.near is None:
            return self
        turns = round((self.angle(position_ticks) - self.near) / math.tau)
        return replace(self, zero_ticks=self.zero_ticks + self.direction * turns * self.servo.position_steps)

    @property
    def title(self) -> str:
        """For the beginning of a sentence."""
        text = str(self)
        return text[0].upper() + text[1:]

    def __str__(self) -> str:
        ids = "".join(f" and {second.id}" for second in self.seconds)
        return f"joint {self.name!r} (ID{'s' if ids else ''} {self.id}{ids}, {self.servo.name})"
