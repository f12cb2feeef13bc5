"""Control tables of the fake servos: address, size, access and range of every register.

Addresses, sizes and signs come from `hil.drivers.control_table`; area, access, factory values and ranges from
`hil.fakes.servo.model_facts`. Indirect addresses and data, Startup Configuration and Backup Ready, which the SDK's
tables leave out, are added here from the e-Manual (pages x/<model>). The address of the 330 series' indirect data
depends on the firmware: see `ModelFacts.indirect_of_firmware`.

A model outside the X series follows its table in the SDK; its motor does not move.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

from hil.drivers.control_table import load_control_table, model_names
from hil.fakes.servo.model_facts import (
    COMMON_INITIAL,
    FACTS,
    NEVER,
    OTHER_SERIES,
    X_INITIAL,
    X_SERIES,
    Blocks,
    ModelFacts,
    RegisterFacts,
)

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates, indexed by the value of the register Baud Rate. The 330 models only go up to 4 MBd."""

TICKS_PER_TURN = 4096
VELOCITY_UNIT_RPM = 0.229

_ADDED = (("Startup Configuration", 60, 1), ("Backup Ready", 147, 1))
_NOT_WRITABLE = ("Present", "Model", "Firmware", "Moving Status", "Hardware Error", "Realtime", "Registered")


@dataclass(frozen=True, slots=True)
class Register:
    """One register: its address, access, and range (inclusive, in its own units)."""

    name: str
    address: int
    size: int
    signed: bool
    eeprom: bool
    writable: bool
    initial: int
    minimum: int
    maximum: int


@dataclass(frozen=True, slots=True)
class EmulatedModel:
    """One servo model: its control table, and properties that the table does not contain."""

    name: str
    number: int
    current_unit_a: float
    """Current per tick of Goal Current and Present Current [A]; 0 if the model has no current sensor."""
    operating_modes: frozenset[int]
    """Supported operating modes; empty if the motor is unknown, in which case it never moves."""
    fast_read_firmware: int
    """First firmware that supports Fast Sync Read, Fast Bulk Read and Control Table Backup."""
    nominal_voltage_v: float
    resistance_ohm: float
    back_emf_v_s: float
    """Voltage per velocity of the output shaft [V s/rad]."""
    senses_supply: bool
    indirect: Blocks
    registers: Mapping[str, Register]


def allowed_values(model: EmulatedModel, register: Register) -> range | frozenset[int]:
    """Return the values that a servo of this model accepts in this register."""
    if register.name == "Operating Mode" and model.operating_modes:
        return model.operating_modes
    return range(register.minimum, register.maximum + 1)


MODEL_NAMES = tuple(FACTS)
"""Servo models with known factory values and ranges."""


def all_model_names() -> tuple[str, ...]:
    """Return the models available as fake servos: `MODEL_NAMES`, then the other models in the SDK's tables."""
    return (*MODEL_NAMES, *sorted(name for name in model_names().values() if name not in FACTS))


DEFAULT_FIRMWARE = 48


def load_model(name: str, firmware: int = DEFAULT_FIRMWARE) -> EmulatedModel:
    """Return the control table of one model, e.g. "XM430-W350", with this firmware.

    Raises KeyError if no table describes the model; see `all_model_names`.
    """
    facts = FACTS.get(name)
    other = facts.indirect_of_firmware if facts is not None else None
    return _load_model(name, other[1] if other is not None and other[0] == firmware else None)


@cache
def _load_model(name: str, indirect: Blocks | None) -> EmulatedModel:
    """Return a model; `indirect` replaces its usual blocks of indirect addressing."""
    if name not in model_names().values():
        raise KeyError(name)
    facts = FACTS.get(name)
    if facts is None:
        return _unknown(name)
    return _x_series(name, facts, indirect or facts.indirect)


def _x_series(name: str, facts: ModelFacts, indirect: Blocks) -> EmulatedModel:
    table = {**X_SERIES, **facts.differs}
    addresses = load_control_table(name)
    registers = [
        _register(entry.name, entry.address, entry.size, entry.signed, table.get(entry.name, RegisterFacts()))
        for entry in addresses.registers.values()
        if not entry.name.startswith("Indirect")
    ]
    known = {register.name for register in registers}
    registers += [_register(*added, False, table[added[0]]) for added in _ADDED if added[0] not in known]
    registers += _indirect_registers(indirect)
    return EmulatedModel(
        name=name,
        number=addresses.number,
        current_unit_a=facts.current_unit_a,
        operating_modes=facts.operating_modes,
        fast_read_firmware=facts.fast_read_firmware,
        nominal_voltage_v=facts.motor.voltage_v,
        resistance_ohm=facts.motor.resistance_ohm,
        back_emf_v_s=facts.motor.back_emf_v_s,
        senses_supply=facts.senses_supply,
        indirect=indirect,
        registers={register.name: register for register in sorted(registers, key=lambda r: r.address)},
    )


def _indirect_registers(blocks: Blocks) -> Iterator[Register]:
    last = max(data + count - 1 for _, data, count in blocks)
    number = 0
    for first_address, first_data, count in blocks:
        for index in range(count):
            number += 1
            data = first_data + index
            points = RegisterFacts(data, (64, last))  # its own data register by default
            yield _register(f"Indirect Address {number}", first_address + 2 * index, 2, False, points)
            yield _register(f"Indirect Data {number}", data, 1, False, RegisterFacts())


def _unknown(name: str) -> EmulatedModel:
    addresses = load_control_table(name)
    torque = addresses.registers.get("Torque Enable")
    ram = torque.address if torque is not None else 64
    taken: set[int] = set()
    registers = {}
    initial = {**COMMON_INITIAL, **X_INITIAL.get(name, {})}
    for entry in addresses.registers.values():
        span = set(range(entry.address, entry.address + entry.size))
        if span & taken:
            continue  # the SDK's second name for the same bytes
        taken |= span
        facts = OTHER_SERIES.get(name, {}).get(entry.name) or RegisterFacts(
            initial=initial.get(entry.name, 0),
            limits=(0, 252) if entry.name == "ID" else None,
            writable=not entry.name.startswith(_NOT_WRITABLE),
        )
        registers[entry.name] = _register(entry.name, entry.address, entry.size, entry.signed, facts, ram)
    return EmulatedModel(
        name=name,
        number=addresses.number,
        current_unit_a=0.0,
        operating_modes=frozenset(),
        fast_read_firmware=NEVER,
        nominal_voltage_v=12.0,
        resistance_ohm=1.0,
        back_emf_v_s=1.0,
        senses_supply=False,
        indirect=(),
        registers=registers,
    )


def _register(name: str, address: int, size: int, signed: bool, facts: RegisterFacts, ram: int = 64) -> Register:
    bits = 8 * size
    everything = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    minimum, maximum = facts.limits or everything
    return Register(
        name=name,
        address=address,
        size=size,
        signed=signed,
        eeprom=address < ram,
        writable=facts.writable,
        initial=facts.initial,
        minimum=minimum,
        maximum=maximum,
    )
