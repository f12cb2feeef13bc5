"""`[[joints]]`: one joint, its servos and its limits."""

from typing import Literal, Self

from pydantic import Field, PositiveFloat, field_validator, model_validator

from hil.config.table import BusId, OneOrList, Printable, Range, Table
from hil.drivers.joint import Joint, SecondServo
from hil.drivers.servo_model import SERVO_MODELS, Mode, servo_model, with_article

USUAL_TORQUE_SPREAD = 0.1
"""Relative standard deviation of the torque constant among servos of one model."""


class JointConfig(Table):
    """`[[joints]]`: one joint, from the base outwards."""

    name: Printable = Field(min_length=1, max_length=20)
    servos: OneOrList[BusId] = Field(alias="id", description="bus ID, or the IDs of the joint's two servos")
    model: Literal[tuple(SERVO_MODELS)]  # type: ignore[valid-type]
    turns: OneOrList[Literal[-1, 1]] = Field(
        1,
        alias="direction",
        description="-1 if the servo turns in the opposite direction to the joint; one entry per servo",
    )
    zero_ticks: int = Field(
        ge=-1_048_575,
        le=1_048_575,
        description="Present Position at which the angle is zero",
    )
    mode: Literal["current", "pwm"] | None = Field(None, description="default: current if the servo model supports it")
    torque_constant: PositiveFloat | None = Field(None, le=100, description="N m/A at the output shaft")
    torque_constant_std: float = Field(0.0, ge=0, le=100, description="N m/A")
    torque_per_volt: PositiveFloat | None = Field(None, le=100, description="N m/V at the output shaft, pwm mode only")
    torque_per_volt_std: float = Field(0.0, ge=0, le=100, description="N m/V")
    position_limit: Range = Field(description="rad")
    velocity_limit: PositiveFloat = Field(description="rad/s")
    current_limit: PositiveFloat | None = Field(None, le=30, description="A")
    voltage_limit: PositiveFloat | None = Field(None, le=30, description="V, pwm mode only")

    @field_validator("zero_ticks", mode="before")
    @classmethod
    def _of_the_first_servo(cls, ticks: object) -> object:
        if isinstance(ticks, list):
            raise ValueError("it must be one whole number; for two servos, give the first servo's value")  # noqa: TRY004  pydantic's
        return ticks

    @field_validator("turns", mode="before")
    @classmethod
    def _no_truth_value(cls, turns: object) -> object:
        if any(isinstance(turn, bool) for turn in (turns if isinstance(turns, list) else [turns])):
            raise ValueError("it must be 1, or -1 if the servo turns the other way")
        return turns

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.position_limit
        if low >= high:
            raise ValueError(f"position_limit = [{low}, {high}]: the first value must be the smaller one")
        return self

    @model_validator(mode="after")
    def _a_direction_for_each_servo(self) -> Self:
        if isinstance(self.servos, list) and not 1 <= len(self.servos) <= 2:
            raise ValueError(f"id has {len(self.servos)} entries: a joint has one or two servos")
        if len(set(self.ids)) < len(self.ids):
            raise ValueError(f"id = {list(self.ids)}: each servo needs its own ID")
        if isinstance(self.turns, list) and len(self.turns) != len(self.ids):
            raise ValueError(f"direction has {len(self.turns)} entries for {len(self.ids)} servos: give one per servo")
        return self

    @property
    def ids(self) -> tuple[int, ...]:
        """The IDs of the joint's servos, the main servo first."""
        return tuple(self.servos) if isinstance(self.servos, list) else (self.servos,)

    @property
    def id(self) -> int:
        """The ID of the joint's servo; of the main servo if there are two."""
        return self.ids[0]

    @property
    def directions(self) -> tuple[int, ...]:
        """Direction of each servo: +1, or -1 if it turns in the opposite direction to the joint."""
        return tuple(self.turns) if isinstance(self.turns, list) else (self.turns,) * len(self.ids)

    @property
    def direction(self) -> int:
        """Direction of the main servo: +1 or -1."""
        return self.directions[0]

    @model_validator(mode="after")
    def _driven(self) -> Self:
        pwm = self.drive_mode is Mode.PWM
        if not pwm and servo_model(self.model).current_unit is None:
            raise ValueError(f'mode = "current": {with_article(self.model)} has no current mode; use "pwm"')
        values = (self.torque_constant, self.current_limit), (self.torque_per_volt, self.voltage_limit)
        names = ("torque_constant", "current_limit"), ("torque_per_volt", "voltage_limit")
        mode = self.drive_mode.name.lower()
        for name, value in zip(names[pwm], values[pwm], strict=True):
            if value is None:
                raise ValueError(f"{name} is missing; {mode} mode needs it")
        for name, value in zip(names[not pwm], values[not pwm], strict=True):
            if value is not None:
                raise ValueError(f"{name} = {value:g} has no meaning in {mode} mode; use {' and '.join(names[pwm])}")
        return self

    @property
    def drive_mode(self) -> Mode:
        if self.mode is None:
            return servo_model(self.model).default_mode
        return Mode[self.mode.upper()]

    @property
    def torque_per_goal(self) -> float:
        """Torque per goal at the output shaft: N m/A, or N m/V in pwm mode."""
        value = self.torque_per_volt if self.drive_mode is Mode.PWM else self.torque_constant
        assert value is not None  # checked above
        return value

    @property
    def torque_per_goal_std(self) -> float:
        return self.torque_per_volt_std if self.drive_mode is Mode.PWM else self.torque_constant_std

    @property
    def torque_spread(self) -> float:
        """Relative standard deviation of the torque per goal: as configured, otherwise the spread among servos of one
        model.
        """
        name = "torque_per_volt_std" if self.drive_mode is Mode.PWM else "torque_constant_std"
        if name not in self.model_fields_set:
            return USUAL_TORQUE_SPREAD
        return self.torque_per_goal_std / self.torque_per_goal

    @property
    def goal_limit_name(self) -> str:
        """Name of the setting that limits the goal in this joint's mode."""
        return "voltage_limit" if self.drive_mode is Mode.PWM else "current_limit"

    @property
    def goal_limit(self) -> float:
        """Largest allowed goal: A, or V in pwm mode."""
        value = self.voltage_limit if self.drive_mode is Mode.PWM else self.current_limit
        assert value is not None  # checked above
        return value

    @property
    def joint(self) -> Joint:
        seconds = tuple(SecondServo(*each) for each in zip(self.ids[1:], self.directions[1:], strict=True))
        return Joint(
            self.name,
            self.id,
            servo_model(self.model),
            self.direction,
            self.zero_ticks,
            self.drive_mode,
            seconds=seconds,
        )
