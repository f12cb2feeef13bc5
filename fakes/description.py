"""The [fake] table of an arm's TOML file: the fake servos on the bus, and the mechanism that they move."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from hil.drivers.clock import Clock
from hil.drivers.packet import MAX_ID
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.fault_effects import jam
from hil.fakes.bus.faults import Fault, FaultKind
from hil.fakes.bus.hand import Move
from hil.fakes.bus.supply import Supply
from hil.fakes.names import arm_names, find_arm
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.chain_arm import ChainArm
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.plant import Plant, load_plant, make_chain, make_plant
from hil.fakes.servo.encoder import PERFECT, Encoder
from hil.fakes.servo.health import Overload, Thermal
from hil.fakes.servo.registers import BAUD_RATES, MODEL_NAMES, all_model_names, allowed_values, load_model
from hil.fakes.servo.servo import EmulatedServo
from hil.toml_errors import Described, describe, meant_name
from hil.toml_file import TomlFileError, load_toml

__all__ = ["DescriptionError", "FakeArm", "FakeServo", "beside", "found_beside", "load_fake", "make_bus"]


class DescriptionError(ValueError):
    """The [fake] table is unreadable or invalid. The message gives the file, key, value and allowed values."""


_KEYS_OF_REGISTERS = {"ID": "id", "Baud Rate": "baud", "Return Delay Time": "return_delay_us"}
"""Keys of a servo's table that set EEPROM registers, by the registers' names."""


def _listed(values: Sequence[int]) -> str:
    return f"{', '.join(map(str, values[:-1]))} or {values[-1]}"


class FakeServo(Described):
    """The initial state of one servo on the bus: set up for its arm and powered, with torque off."""

    id: Annotated[int, Field(ge=0, le=MAX_ID, description="bus ID")]
    model: Annotated[str, Field(description='name as printed on the servo, e.g. "XM430-W350"')]
    zero_ticks: Annotated[
        int, Field(ge=-(1 << 20), le=1 << 20, description="Present Position at which the joint's angle is 0")
    ]
    direction: Annotated[int, Field(description="-1 if the servo turns in the opposite direction to the joint")] = 1
    joint: Annotated[
        int | None,
        Field(ge=1, description="joint that it moves, counted from 1; by default, the previous servo's joint plus 1"),
    ] = None
    firmware: Annotated[int, Field(ge=38, le=255, description="Firmware Version")] = 48
    baud: Annotated[int, Field(description="baud rate to which the servo is set")] = 1_000_000
    return_delay_us: Annotated[
        int, Field(ge=0, le=508, multiple_of=2, description="Return Delay Time [us]; factory default 500")
    ] = 0
    input_voltage_v: Annotated[
        float | None, Field(gt=0, le=100, description="supply voltage [V]; by default the model's nominal voltage")
    ] = None
    temperature_c: Annotated[float, Field(ge=0, le=255, description="temperature inside the servo [C]")] = 35.0
    current_noise_a: Annotated[float, Field(ge=0, le=10, description="standard deviation of Present Current [A]")] = 0.0
    senses_supply: Annotated[
        bool | None,
        Field(
            description="whether Present Current is the supply current, not the motor's; default depends on the model"
        ),
    ] = None
    encoder: Annotated[Encoder, Field(description="errors of Present Position; none by default")] = PERFECT
    clock_error_ppm: Annotated[float, Field(ge=-1e5, le=1e5, description="clock error; positive: fast [ppm]")] = 0.0
    voltage_limited: Annotated[
        bool, Field(description="whether supply voltage and back-EMF also limit the current in current mode")
    ] = False
    thermal: Annotated[Thermal | None, Field(description="heating by the motor current; none by default")] = None
    overload: Annotated[
        Overload | None,
        Field(description="conditions for an overload shutdown; by default, the servo never shuts down"),
    ] = None
    registers: Annotated[
        dict[str, int],
        Field(
            description="values of EEPROM registers that no other key sets, if they differ from the factory defaults"
        ),
    ] = {}  # noqa: RUF012  # pydantic copies it

    @field_validator("model")
    @classmethod
    def _known_model(cls, model: str) -> str:
        if model not in all_model_names():
            if near := meant_name(model, all_model_names()):
                raise ValueError(f"did you mean {near}?")
            others = ", ".join(all_model_names()[len(MODEL_NAMES) :])
            raise ValueError(
                f"known models: {', '.join(MODEL_NAMES)}; known only by register addresses and sizes: {others}"
            )
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
        model = load_model(self.model, self.firmware)
        for name, value in self.registers.items():
            register = model.registers.get(name)
            if register is None or not register.eeprom or not register.writable:
                raise ValueError(f'registers: "{name}" is not a settable EEPROM register of the {self.model}')
            if key := _KEYS_OF_REGISTERS.get(name):
                raise ValueError(f'registers: "{name}" = {value}: not allowed here, because the key {key} sets it')
            allowed = allowed_values(model, register)
            if value not in allowed:
                said = _listed(sorted(allowed)) if isinstance(allowed, frozenset) else f"{allowed[0]} to {allowed[-1]}"
                raise ValueError(f'registers: "{name}" = {value}: {said} is allowed for the {self.model}')
        return self

    @model_validator(mode="after")
    def _baud_of_the_model(self) -> Self:
        model = load_model(self.model, self.firmware)
        register = model.registers.get("Baud Rate")
        if register is not None and BAUD_RATES.index(self.baud) not in allowed_values(model, register):
            highest = BAUD_RATES[min(register.maximum, len(BAUD_RATES) - 1)]
            raise ValueError(f"baud = {self.baud}: at most {highest} is allowed for the {self.model}")
        return self


class FakeArm(Described):
    """The whole [fake] table: an adapter, the servos on its bus, and the arm that they move."""

    seed: Annotated[int, Field(ge=0, description="random seed for noise and faults")] = 0
    adapter_latency_us: Annotated[
        float, Field(ge=0, le=1e6, description="delay of every byte between wire and host [us]")
    ] = 0.0
    adapter_echoes: Annotated[bool, Field(description="whether the adapter echoes what the host sends")] = False
    servos: Annotated[
        tuple[FakeServo, ...],
        Field(strict=False, min_length=1, description="servos on the bus, in the order of the joints"),
    ]
    arm: Annotated[Arm | None, Field(description="links and drives of a planar arm")] = None
    chain: Annotated[ChainArm | None, Field(description="a spatial arm described by a URDF, instead of `arm`")] = None
    plant: Annotated[
        str | None,
        Field(description='"module:factory" of a custom mechanism, instead of `arm`; see hil.fakes.plants.plant'),
    ] = None
    plant_options: Annotated[dict[str, Any], Field(description="arguments of the factory")] = {}  # noqa: RUF012
    supply: Annotated[Supply | None, Field(description="resistance of the supply; none by default")] = None
    faults: Annotated[tuple[Fault, ...], Field(strict=False, description="faults to inject")] = ()
    moves: Annotated[
        tuple[Move, ...], Field(strict=False, description="movements by hand of joints whose torque is off")
    ] = ()
    _folder: Path | None = None
    """Folder of the TOML file, where the module of a custom plant may be."""

    @model_validator(mode="after")
    def _a_servo_for_each_joint(self) -> Self:
        ids = [servo.id for servo in self.servos]
        if sum(each is not None for each in (self.arm, self.chain, self.plant)) != 1:
            raise ValueError('give exactly one of these: the table arm, the table chain, or plant = "module:factory"')
        count = max(self.joints) + 1
        if set(self.joints) != set(range(count)):
            moved = ", ".join(str(joint + 1) for joint in self.joints)
            raise ValueError(f"servos: they move joints {moved}, but every joint from 1 to the highest needs a servo")
        arm = self.arm or self.chain
        if arm is not None and count != len(arm.drives):
            servos = f"{len(ids)} servos" + (f" on {count} joints" if count != len(ids) else "")
            raise ValueError(f"{servos} for {len(arm.drives)} drives of the arm: each drive needs a servo")
        for fault in self.faults:
            if fault.servo is not None and fault.servo not in ids:
                raise ValueError(
                    f"faults: {fault.kind}: no servo has the ID {fault.servo}; the IDs are {', '.join(map(str, ids))}"
                )
        for move in self.moves:
            if move.servo not in ids:
                raise ValueError(f"moves: no servo has the ID {move.servo}; the IDs are {', '.join(map(str, ids))}")
        return self

    @property
    def joints(self) -> tuple[int, ...]:
        """Index of the joint that each servo moves."""
        moved: list[int] = []
        for servo in self.servos:
            behind = moved[-1] + 1 if moved else 0
            moved.append(behind if servo.joint is None else servo.joint - 1)
        return tuple(moved)

    def make_plant(self) -> Plant:
        """Return the mechanism in its initial state at time 0; raises PlantError."""
        if self.arm is not None:
            return make_plant(self.arm)
        if self.chain is not None:
            return make_chain(self.chain)
        name = self.plant or ""
        plant = load_plant(name, self.plant_options, self._folder)
        count = max(self.joints) + 1
        if plant.joints != count:
            servos = f"{len(self.servos)} servos" + (f" on {count}" if count != len(self.servos) else "")
            raise PlantError(f'plant = "{name}" has {plant.joints} joints for {servos}')
        return plant


def beside(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the [fake] table with the path of its chain's URDF resolved relative to the TOML file's `folder`.

    If there is no file at that path, a file of the same name in `folder` itself is used, as in a run folder.
    """
    chain = values.get("chain")
    if not isinstance(chain, dict) or not isinstance(chain.get("urdf"), str):
        return values
    return {**values, "chain": {**chain, "urdf": str(found_beside(folder, chain["urdf"]))}}


def found_beside(folder: Path, name: str) -> Path:
    """Return the path of the file `name`, relative to `folder`. If there is no such file, but `folder` itself contains
    a file with the same base name, return the path of that file.
    """
    named, beside = folder / name, folder / Path(name).name
    return beside if beside.is_file() and not named.is_file() else named


def _known_names(name: str) -> str:
    if "." in name or "/" in name:
        return ""
    close = get_close_matches(name, arm_names(), 1, 0.75)
    return f"; did you mean {close[0]}?" if close else f"; arms known by name: {', '.join(arm_names())}"


def load_fake(path: Path | str) -> FakeArm:
    """Return the [fake] table of a TOML file or of a bundled arm given by name (see `hil.fakes.names`).

    Other tables of the file are ignored. Raises `DescriptionError`.
    """
    path = find_arm(path)
    try:
        document = load_toml(path)
    except TomlFileError as error:
        hint = _known_names(str(path)) if isinstance(error.__cause__, OSError) else ""
        raise DescriptionError(f"{str(error).rstrip('.')}{hint}") from error
    table = document.get("fake")
    if not isinstance(table, dict):
        raise DescriptionError(f"{path} has no [fake] table, so there is no fake arm to open")
    try:
        fake = FakeArm.model_validate(beside(table, path.parent))
    except ValidationError as error:
        raise DescriptionError(describe(error, path, FakeArm, "fake")) from error
    if fake.plant is not None:
        fake._folder = path.resolve().parent
    return fake


def make_bus(fake: FakeArm, clock: Clock) -> FakeBus:
    """Return the described bus: servos powered up at the clock's current time, the arm at rest in its initial pose.

    Raises PlantError if a custom plant cannot be created, or does not support the described faults or moves.
    """
    servos = [
        EmulatedServo(
            load_model(servo.model, servo.firmware),
            servo.id,
            zero_ticks=servo.zero_ticks,
            direction=servo.direction,
            firmware=servo.firmware,
            baud=servo.baud,
            return_delay_us=servo.return_delay_us,
            input_voltage_v=servo.input_voltage_v,
            temperature_c=servo.temperature_c,
            registers=servo.registers,
            current_noise_a=servo.current_noise_a,
            encoder=servo.encoder,
            senses_supply=servo.senses_supply,
            clock_error_ppm=servo.clock_error_ppm,
            voltage_limited=servo.voltage_limited,
            thermal=servo.thermal,
            overload=servo.overload,
            seed=fake.seed,
        )
        for servo in fake.servos
    ]
    plant = fake.make_plant()
    if any(fault.kind is FaultKind.STUCK_JOINT for fault in fake.faults):
        jam(plant, 0, jammed=False)  # a plant without this is refused now, not in the middle of a run
    bus = FakeBus(
        servos,
        plant,
        clock,
        joints=fake.joints,
        adapter_latency_us=fake.adapter_latency_us,
        adapter_echoes=fake.adapter_echoes,
        supply=fake.supply,
        seed=fake.seed,
    )
    bus.faults.add(*fake.faults)
    bus.hand.schedule(*fake.moves)
    return bus
