"""The [fake] table of an arm's TOML file: which fake servos hang on the bus, and what they move."""

import tomllib
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from drivers.clock import Clock
from drivers.packet import MAX_ID
from fakes.arm import Arm
from fakes.bus import FakeBus
from fakes.plant import make_plant
from fakes.registers import BAUD_RATES, MODEL_NAMES, load_model
from fakes.servo import Servo
from fakes.table_errors import describe


class DescriptionError(ValueError):
    """The [fake] table cannot be read or is wrong. The message names file, key, value and what is allowed."""


class FakeServo(BaseModel):
    """One servo, as it lies on the bench: set up for its arm, switched on, torque off."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    id: Annotated[int, Field(ge=0, le=MAX_ID, description="bus ID")]
    model: Annotated[str, Field(description='name as printed on the servo, e.g. "XM430-W350"')]
    zero_ticks: Annotated[int, Field(description="Present Position at which the joint's angle is 0")]
    direction: Annotated[int, Field(description="-1 where the servo turns against the joint")] = 1
    firmware: Annotated[int, Field(ge=38, le=255, description="Firmware Version")] = 48
    baud: Annotated[int, Field(description="baud rate the servo is set to")] = 1_000_000
    return_delay_us: Annotated[
        int, Field(ge=0, le=508, multiple_of=2, description="Return Delay Time [us]; 500 from the factory")
    ] = 0
    input_voltage_v: Annotated[
        float | None, Field(gt=0, le=100, description="supply [V]; the model's nominal voltage unless given")
    ] = None
    temperature_c: Annotated[float, Field(ge=0, le=255, description="inside the servo [C]")] = 35.0
    registers: Annotated[
        dict[str, int], Field(description="other EEPROM registers that are not at their factory value")
    ] = {}

    @field_validator("model")
    @classmethod
    def _known_model(cls, model: str) -> str:
        if model not in MODEL_NAMES:
            raise ValueError(f"the fake bus knows {', '.join(MODEL_NAMES)}")
        return model

    @field_validator("direction")
    @classmethod
    def _unit_direction(cls, direction: int) -> int:
        if direction not in (-1, 1):
            raise ValueError("1 or -1 is allowed")
        return direction

    @field_validator("baud")
    @classmethod
    def _known_baud(cls, baud: int) -> int:
        if baud not in BAUD_RATES:
            raise ValueError(f"{', '.join(map(str, BAUD_RATES))} are allowed")
        return baud

    @model_validator(mode="after")
    def _known_registers(self) -> Self:
        table = load_model(self.model).registers
        for name, value in self.registers.items():
            register = table.get(name)
            if register is None or not register.eeprom or not register.writable:
                raise ValueError(f'registers: "{name}" is not an EEPROM register of the {self.model} that can be set')
            if not register.minimum <= value <= register.maximum:
                raise ValueError(f'registers: "{name}" = {value}: {register.minimum} to {register.maximum} is allowed')
        return self


class FakeArm(BaseModel):
    """The whole [fake] table: an adapter, servos on its bus, and the arm that they move."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    seed: Annotated[int, Field(ge=0, description="of everything random here; nothing is, so far")] = 0
    adapter_latency_us: Annotated[
        float, Field(ge=0, le=1e6, description="from the wire to the host's read, for every byte [us]")
    ] = 0.0
    servos: Annotated[
        tuple[FakeServo, ...], Field(strict=False, min_length=1, description="in the order of the joints")
    ]
    arm: Annotated[Arm, Field(description="links and drives")]

    @model_validator(mode="after")
    def _one_servo_per_joint(self) -> Self:
        ids = [servo.id for servo in self.servos]
        if len(set(ids)) < len(ids):
            raise ValueError(f"servos: IDs {', '.join(map(str, ids))}: each servo on a bus needs an ID of its own")
        if len(ids) != len(self.arm.drives):
            raise ValueError(f"{len(ids)} servos for {len(self.arm.drives)} drives of the arm: one servo per drive")
        return self


def load_fake(path: Path | str) -> FakeArm:
    """The [fake] table of a TOML file; the file's other tables are not looked at. Raises `DescriptionError`."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DescriptionError(f"{path}: is not TOML: {error}") from error
    table = document.get("fake")
    if not isinstance(table, dict):
        raise DescriptionError(f"{path}: has no [fake] table, so there is no fake arm to open")
    try:
        return FakeArm.model_validate(table)
    except ValidationError as error:
        raise DescriptionError(describe(error, path, FakeArm, "fake")) from error


def make_bus(fake: FakeArm, clock: Clock) -> FakeBus:
    """The described servos, switched on at the clock's present time with the arm at rest in its starting pose."""
    servos = [
        Servo(
            load_model(servo.model),
            servo.id,
            zero_ticks=servo.zero_ticks,
            direction=servo.direction,
            firmware=servo.firmware,
            baud=servo.baud,
            return_delay_us=servo.return_delay_us,
            input_voltage_v=servo.input_voltage_v,
            temperature_c=servo.temperature_c,
            registers=servo.registers,
        )
        for servo in fake.servos
    ]
    return FakeBus(servos, make_plant(fake.arm), clock, adapter_latency_us=fake.adapter_latency_us)
