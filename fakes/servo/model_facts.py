"""Facts that the SDK's control tables leave out: access, factory values and ranges of registers, and motor constants.

Source: ROBOTIS e-Manual, pages x/<model> (revisions of 2020 to 2024). Three entries differ from what some revisions
print. The range of Min Voltage Limit, given there as 110 to 300 around a factory value of 95, is 95 to 160 here as on
the sister models. Protocol Type only accepts 2, because a fake servo does not support any other. Drive Mode accepts bit
3 (Torque On by Goal Update), which is on the page of the XL430-W250 but missing from older revisions of the others.

Resistance and back-EMF are computed from stall current and no-load speed at the nominal voltage. They are accurate to
tens of percent, which is enough to make a position move look right. The XC330-T288's stall current is uncertain.

A model without its own facts uses those of a sister model, named in `STANDS_FOR`: its factory values and ranges are
uncertain.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class RegisterFacts:
    """Properties of a register that its control table does not contain. `limits` None: the full range of its bytes."""

    initial: int = 0
    limits: tuple[int, int] | None = None
    writable: bool = True


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """What distinguishes one model.

    current_unit_a: current per tick of Goal and Present Current [A].
    fast_read_firmware: first firmware with fast reads and Control Table Backup.
    resistance_ohm: resistance of the motor [ohm].
    back_emf_v_s: back-EMF per velocity of the output shaft [V s/rad].
    differs: registers whose facts differ from those of the X series.
    """

    current_unit_a: float
    fast_read_firmware: int
    resistance_ohm: float
    back_emf_v_s: float
    differs: Mapping[str, RegisterFacts] = field(default_factory=dict)
    operating_modes: frozenset[int] = frozenset({0, 1, 3, 4, 5, 16})
    nominal_voltage_v: float = 12.0
    senses_supply: bool = False
    """Whether Present Current is the supply current instead of the motor current (330 series)."""
    indirect: tuple[tuple[int, int, int], ...] = ((168, 224, 28), (578, 634, 28))
    """Blocks of indirect addressing: address of the first address register and first data register, and their number.
    """
    older_indirect: tuple[tuple[int, int, int], ...] | None = None
    """The blocks in firmware before `INDIRECT_MOVED_FIRMWARE`, where they differ."""


_Facts = RegisterFacts
_GAIN = (0, 16_383)
_READ_ONLY = _Facts(writable=False)
NEVER = 256
"""A firmware version that no servo has."""

INDIRECT_MOVED_FIRMWARE = 52
"""First firmware with which the 330 series has its indirect data at 208.

Source: dynamixel-sdk 4.1 and ROBOTIS' dynamixel_hardware_interface (pull request 69) have one control table for older
330 servos, with the data at 224, and a second one named fw52, with the data at 208. The e-Manual only mentions 208.
"""

REVERSES_ALL = ("XM540", "XH540", "XD540", "XW540", "XW430")
"""Series whose Reverse Mode inverts velocity, current and PWM as well as position (e-Manual, Drive Mode, by series)."""

X_SERIES: Mapping[str, RegisterFacts] = {
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
    "Startup Configuration": _Facts(0, (0, 3)),
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
    "Backup Ready": _READ_ONLY,
}

_330 = {
    "Baud Rate": _Facts(1, (0, 6)),
    "Temperature Limit": _Facts(70, (0, 100)),
}

FACTS: Mapping[str, ModelFacts] = {
    "XM430-W350": ModelFacts(2.69e-3, 45, 5.2, 2.49),
    "XM430-W210": ModelFacts(2.69e-3, 45, 5.2, 1.49, {"Velocity Limit": _Facts(330, (0, 1023))}),
    "XH430-W350": ModelFacts(
        2.69e-3,
        45,
        9.2,
        3.82,
        {
            "Current Limit": _Facts(648, (0, 648)),
            "Velocity Limit": _Facts(130, (0, 1023)),
            "Position P Gain": _Facts(900, _GAIN),
        },
    ),
    "XM540-W270": ModelFacts(
        2.69e-3,
        45,
        2.7,
        3.82,
        {"Current Limit": _Facts(2047, (0, 2047)), "Velocity Limit": _Facts(128, (0, 1023))},
    ),
    "XL330-M288": ModelFacts(
        1.0e-3,
        46,
        3.4,
        0.464,
        {
            **_330,
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
        indirect=((168, 208, 20),),
        older_indirect=((168, 224, 20),),
    ),
    "XC330-T288": ModelFacts(
        1.0e-3,
        46,
        13.9,
        1.63,
        {
            **_330,
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
        senses_supply=True,
        indirect=((168, 208, 20),),
        older_indirect=((168, 224, 20),),
    ),
    "XL430-W250": ModelFacts(
        0.0,
        45,
        8.5,
        1.86,
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

STANDS_FOR: Mapping[str, str] = {
    "XH430-W210": "XM430-W210",
    "XD430-T210": "XM430-W210",
    "XD430-T350": "XH430-W350",
    "XW430-T200": "XM430-W210",
    "XW430-T333": "XM430-W350",
    "XM540-W150": "XM540-W270",
    "XH540-W150": "XM540-W270",
    "XH540-W270": "XM540-W270",
    "XD540-T150": "XM540-W270",
    "XD540-T270": "XM540-W270",
    "XW540-T140": "XM540-W270",
    "XW540-T260": "XM540-W270",
    "XL330-M077": "XL330-M288",
    "XC330-M181": "XC330-T288",
    "XC330-M288": "XC330-T288",
    "XC330-T181": "XC330-T288",
    "XC430-W150": "XL430-W250",
    "XC430-W240": "XL430-W250",
}
"""Models without their own facts, and the sister model whose factory values and ranges they assume."""

_STRENGTH = (0, 1023)

OTHER_SERIES: Mapping[str, Mapping[str, RegisterFacts]] = {
    "XL320": {
        "Baud Rate": _Facts(3, (0, 3)),
        "Return Delay Time": _Facts(250, (0, 254)),
        "CW Angle Limit": _Facts(0, _STRENGTH),
        "CCW Angle Limit": _Facts(1023, _STRENGTH),
        "Control Mode": _Facts(2, (1, 2)),
        "Temperature Limit": _Facts(65, (0, 150)),
        "Min Voltage Limit": _Facts(60, (50, 250)),
        "Max Voltage Limit": _Facts(90, (50, 250)),
        "Max Torque": _Facts(1023, _STRENGTH),
        "Status Return Level": _Facts(2, (0, 2)),
        "Shutdown": _Facts(3, (0, 7)),
        "Torque Enable": _Facts(0, (0, 1)),
        "LED": _Facts(0, (0, 7)),  # three bits: red, green, blue
        "D Gain": _Facts(0, (0, 254)),
        "I Gain": _Facts(0, (0, 254)),
        "P Gain": _Facts(32, (0, 254)),
        "Goal Position": _Facts(0, _STRENGTH),
        "Moving Speed": _Facts(0, (0, 2047)),
        "Torque Limit": _Facts(1023, _STRENGTH),
        "Punch": _Facts(32, _STRENGTH),
    }
}
"""Registers of models outside the X series, as far as their e-Manual pages describe them."""
