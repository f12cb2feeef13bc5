"""One joint of the arm: which servo moves it, and how its ticks become SI units."""

from dataclasses import dataclass

from hil.drivers.servo_model import FULL_PWM_TICKS, VELOCITY_UNIT, Mode, ServoModel


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint and its servo.

    direction: +1 or -1, the joint's sense of rotation against the servo's.
    zero_ticks: Present Position at which the joint's angle is zero.
    mode: what a goal is, a current [A] or a voltage [V]. Raises ValueError for a current that the servo does not have.
    """

    name: str
    id: int
    servo: ServoModel
    direction: int = 1
    zero_ticks: int = 0
    mode: Mode = Mode.CURRENT

    def __post_init__(self) -> None:
        if self.mode is Mode.CURRENT and self.servo.current_unit is None:
            raise ValueError(f"{self} has no current mode; drive it in PWM mode.")

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

    @property
    def title(self) -> str:
        """For the beginning of a sentence."""
        text = str(self)
        return text[0].upper() + text[1:]

    def __str__(self) -> str:
        return f"joint {self.name!r} (ID {self.id}, {self.servo.name})"
