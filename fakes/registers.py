"""Control tables of the fake servos: what each register is, where it lies, what may be written to it.

Addresses, sizes and signs come from `drivers.control_table`. Area, access, factory values and ranges are not known
there; they are written down here, from the control tables of the ROBOTIS e-Manual (pages x/<model>). Two
entries differ from what some revisions of those pages print: the Min Voltage Limit's range, given there as 110 to 300
around a factory value of 95, is 95 to 160 as on the sister models; and Protocol Type accepts 2 alone, because a fake
servo speaks nothing else.

Indirect addresses and data (168 and up) are not part of these tables yet: reading them is an Access error.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

from drivers.control_table import load_control_table

EEPROM_END = 64
"""First address of the RAM area on every X-series servo."""

INDIRECT_START = 168
"""First address that is not modelled: the indirect addresses."""

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud by the value of the register Baud Rate. The 330 models end at 4 M."""

TICKS_PER_TURN = 4096
VELOCITY_UNIT_RPM = 0.229


@dataclass(frozen=True, slots=True)
class Register:
    """One register: where it lies, who may write it, and within which range (inclusive, in its own units)."""

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
class Model:
    """One servo model: its control table by name, and what the table does not say."""

    name: str
    number: int
    current_unit_a: float
    """Ampere per tick of Goal Current and Present Current; 0 where the model senses no current."""
    operating_modes: frozenset[int]
    fast_read_firmware: int
    """First firmware that knows Fast Sync Read."""
    nominal_voltage_v: float
    registers: Mapping[str, Register]


@dataclass(frozen=True, slots=True)
class _Facts:
    """What `drivers.control_table` does not say about one register. `limits` None: everything its bytes can hold."""

    initial: int = 0
    limits: tuple[int, int] | None = None
    writable: bool = True


_GAIN = (0, 16_383)
_READ_ONLY = _Facts(writable=False)

_X_SERIES: dict[str, _Facts] = {
    "Model Number": _READ_ONLY,
    "Model Information": _READ_ONLY,
    "Firmware Version": _READ_ONLY,
    "ID": _Facts(1, (0, 252)),
    "Baud Rate": _Facts(1, (0, 7)),
    "Return Delay Time": _Facts(250, (0, 254)),
    "Drive Mode": _Facts(0, (0, 13)),
    "Operating Mode": _Facts(3, (0, 16)),
    "Secondary(Shadow) ID": _Facts(255),
    "Protocol Type": _Facts(2, (2, 2)),
    "Homing Offset": _Facts(0, (-1_044_479, 1_044_479)),
    "Moving Threshold": _Facts(10, (0, 1023)),
    "Temperature Limit": _Facts(80, (0, 100)),
    "Max Voltage Limit": _Facts(160, (95, 160)),
    "Min Voltage Limit": _Facts(95, (95, 160)),
    "PWM Limit": _Facts(885, (0, 885)),
    "Current Limit": _Facts(1193, (0, 1193)),
    "Velocity Limit": _Facts(200, (0, 1023)),
    "Max Position Limit": _Facts(4095, (0, 4095)),
    "Min Position Limit": _Facts(0, (0, 4095)),
    "External Port Mode 1": _Facts(3, (0, 3)),
    "External Port Mode 2": _Facts(3, (0, 3)),
    "External Port Mode 3": _Facts(3, (0, 3)),
    "PWM Slope": _Facts(140, (1, 255)),
    "Shutdown": _Facts(52),
    "Torque Enable": _Facts(0, (0, 1)),
    "LED": _Facts(0, (0, 1)),
    "Status Return Level": _Facts(2, (0, 2)),
    "Registered Instruction": _READ_ONLY,
    "Hardware Error Status": _READ_ONLY,
    "Velocity I Gain": _Facts(1920, _GAIN),
    "Velocity P Gain": _Facts(100, _GAIN),
    "Position D Gain": _Facts(0, _GAIN),
    "Position I Gain": _Facts(0, _GAIN),
    "Position P Gain": _Facts(800, _GAIN),
    "Feedforward 2nd Gain": _Facts(0, _GAIN),
    "Feedforward 1st Gain": _Facts(0, _GAIN),
    "Bus Watchdog": _Facts(0, (0, 127)),
    "Goal PWM": _Facts(),
    "Goal Current": _Facts(),
    "Goal Velocity": _Facts(),
    "Profile Acceleration": _Facts(0, (0, 32_767)),
    "Profile Velocity": _Facts(0, (0, 32_767)),
    "Goal Position": _Facts(),
    "Realtime Tick": _READ_ONLY,
    "Moving": _READ_ONLY,
    "Moving Status": _READ_ONLY,
    "Present PWM": _READ_ONLY,
    "Present Current": _READ_ONLY,
    "Present Load": _READ_ONLY,
    "Present Velocity": _READ_ONLY,
    "Present Position": _READ_ONLY,
    "Velocity Trajectory": _READ_ONLY,
    "Position Trajectory": _READ_ONLY,
    "Present Input Voltage": _READ_ONLY,
    "Present Temperature": _READ_ONLY,
    "External Port Data 1": _Facts(0),
    "External Port Data 2": _Facts(0),
    "External Port Data 3": _Facts(0),
}


@dataclass(frozen=True, slots=True)
class _ModelFacts:
    current_unit_a: float
    fast_read_firmware: int
    differs: Mapping[str, _Facts] = field(default_factory=dict)
    operating_modes: frozenset[int] = frozenset({0, 1, 3, 4, 5, 16})
    nominal_voltage_v: float = 12.0


_MODELS: dict[str, _ModelFacts] = {
    "XM430-W350": _ModelFacts(2.69e-3, 45),
    "XM430-W210": _ModelFacts(2.69e-3, 45, {"Velocity Limit": _Facts(330, (0, 1023))}),
    "XH430-W350": _ModelFacts(
        2.69e-3,
        45,
        {
            "Current Limit": _Facts(648, (0, 648)),
            "Velocity Limit": _Facts(130, (0, 1023)),
            "Position P Gain": _Facts(900, _GAIN),
        },
    ),
    "XM540-W270": _ModelFacts(
        2.69e-3,
        45,
        {"Current Limit": _Facts(2047, (0, 2047)), "Velocity Limit": _Facts(128, (0, 1023))},
    ),
    "XL330-M288": _ModelFacts(
        1.0e-3,
        46,
        {
            "Baud Rate": _Facts(1, (0, 6)),
            "Temperature Limit": _Facts(70, (0, 100)),
            "Max Voltage Limit": _Facts(70, (31, 70)),
            "Min Voltage Limit": _Facts(35, (31, 70)),
            "Current Limit": _Facts(1750, (0, 1750)),
            "Velocity Limit": _Facts(445, (0, 2047)),
            "Shutdown": _Facts(53),
            "Velocity I Gain": _Facts(1600, _GAIN),
            "Velocity P Gain": _Facts(180, _GAIN),
            "Position P Gain": _Facts(400, _GAIN),
        },
        nominal_voltage_v=5.0,
    ),
    "XC330-T288": _ModelFacts(
        1.0e-3,
        46,
        {
            "Baud Rate": _Facts(1, (0, 6)),
            "Temperature Limit": _Facts(70, (0, 100)),
            "Max Voltage Limit": _Facts(140, (55, 140)),
            "Min Voltage Limit": _Facts(55, (55, 140)),
            "Current Limit": _Facts(910, (0, 910)),
            "Velocity Limit": _Facts(320, (0, 2047)),
            "PWM Slope": _Facts(255, (1, 255)),
            "Velocity I Gain": _Facts(1200, _GAIN),
            "Velocity P Gain": _Facts(40, _GAIN),
            "Position P Gain": _Facts(900, _GAIN),
        },
        nominal_voltage_v=11.1,
    ),
    "XL430-W250": _ModelFacts(
        0.0,
        45,
        {
            "Temperature Limit": _Facts(72, (0, 100)),
            "Max Voltage Limit": _Facts(140, (60, 140)),
            "Min Voltage Limit": _Facts(60, (60, 140)),
            "Velocity Limit": _Facts(265, (0, 1023)),
            "Velocity I Gain": _Facts(1000, _GAIN),
            "Position D Gain": _Facts(4000, _GAIN),
            "Position P Gain": _Facts(640, _GAIN),
        },
        operating_modes=frozenset({1, 3, 4, 16}),
        nominal_voltage_v=11.1,
    ),
}

MODEL_NAMES = tuple(_MODELS)
"""Servo models that the fake knows."""


@cache
def load_model(name: str) -> Model:
    """The control table of one model, e.g. "XM430-W350".

    Raises KeyError when the fake does not know the model; `MODEL_NAMES` lists those it knows.
    """
    facts = _MODELS[name]
    table = _X_SERIES | dict(facts.differs)
    addresses = load_control_table(name)
    registers = {
        entry.name: _register(entry.name, entry.address, entry.size, entry.signed, table[entry.name])
        for entry in addresses.registers.values()
        if entry.address < INDIRECT_START
    }
    return Model(
        name=name,
        number=addresses.number,
        current_unit_a=facts.current_unit_a,
        operating_modes=facts.operating_modes,
        fast_read_firmware=facts.fast_read_firmware,
        nominal_voltage_v=facts.nominal_voltage_v,
        registers=registers,
    )


def _register(name: str, address: int, size: int, signed: bool, facts: _Facts) -> Register:
    bits = 8 * size
    everything = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    minimum, maximum = facts.limits or everything
    return Register(
        name=name,
        address=address,
        size=size,
        signed=signed,
        eeprom=address < EEPROM_END,
        writable=facts.writable,
        initial=facts.initial,
        minimum=minimum,
        maximum=maximum,
    )
