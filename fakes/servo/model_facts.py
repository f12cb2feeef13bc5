"""Properties missing from the SDK's control tables: registers' access, factory values and ranges; motor constants.

Source: ROBOTIS e-Manual, pages x/<model> and, for the motors, _data/dxl_x_info.yml and _includes/common/compatible_dxl/
of the e-Manual's repository ROBOTIS-GIT/emanual (revisions of 2018 to 2024). Differences from some revisions: the range
of Min Voltage Limit, given there as 110 to 300 with a factory value of 95, is 95 to 160 here, as on the sister models.
Protocol Type only accepts 2, because a fake servo does not support any other. Drive Mode accepts bit 3 (Torque On by
Goal Update), which is on the page of the XL430-W250 but missing from older revisions of the other pages. Velocity Limit
of the XH430-W210 is that of the XD430-T210, although the oldest page of the XH430-W210 itself states 360.

Resistance and back-EMF are computed from stall current and no-load speed at the nominal voltage. They are accurate to
tens of percent, which is enough for position moves to look realistic.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

Blocks = tuple[tuple[int, int, int], ...]
"""Blocks of indirect addressing: addresses of the first Indirect Address and Indirect Data, and number of each."""


@dataclass(frozen=True, slots=True)
class RegisterFacts:
    """Register properties that control tables do not state.

    `limits` is None if the register accepts every value that fits into its bytes.
    """

    initial: int = 0
    limits: tuple[int, int] | None = None
    writable: bool = True


class Motor(NamedTuple):
    """Published motor data: nominal voltage [V], stall current [A], no-load speed of the output shaft [rev/min]."""

    voltage_v: float
    stall_a: float
    no_load_rpm: float

    @property
    def resistance_ohm(self) -> float:
        """Resistance between the motor's terminals [ohm]."""
        return round(self.voltage_v / self.stall_a, 1)

    @property
    def back_emf_v_s(self) -> float:
        """Back-EMF per unit velocity of the output shaft [V s/rad]."""
        return float(f"{self.voltage_v / (self.no_load_rpm * math.tau / 60):.3g}")


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Properties that differ between models.

    motor: data of the motor at the nominal voltage.
    differs: registers whose properties differ from those of the X series.
    current_unit_a: current per tick of Goal and Present Current [A].
    fast_read_firmware: first firmware with fast reads and Control Table Backup.
    """

    motor: Motor
    differs: Mapping[str, RegisterFacts] = field(default_factory=dict)
    current_unit_a: float = 2.69e-3
    fast_read_firmware: int = 45
    operating_modes: frozenset[int] = frozenset({0, 1, 3, 4, 5, 16})
    senses_supply: bool = False
    """Whether Present Current is the supply current instead of the motor current (330 series)."""
    indirect: Blocks = ((168, 224, 28), (578, 634, 28))
    indirect_of_firmware: tuple[int, Blocks] | None = None
    """The only firmware version with blocks other than `indirect`, and its blocks."""


_Facts = RegisterFacts
_GAIN = (0, 16_383)
_READ_ONLY = _Facts(writable=False)
NEVER = 256
"""A firmware version that no servo has, for features that no firmware supports."""

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


def _volts(low: int, factory_low: int, high: int) -> dict[str, RegisterFacts]:
    return {"Max Voltage Limit": _Facts(high, (low, high)), "Min Voltage Limit": _Facts(factory_low, (low, high))}


def _gains(
    *, velocity_i: int = 1920, velocity_p: int = 100, d: int = 0, i: int = 0, p: int = 800
) -> dict[str, RegisterFacts]:
    return {
        "Velocity I Gain": _Facts(velocity_i, _GAIN),
        "Velocity P Gain": _Facts(velocity_p, _GAIN),
        "Position D Gain": _Facts(d, _GAIN),
        "Position I Gain": _Facts(i, _GAIN),
        "Position P Gain": _Facts(p, _GAIN),
    }


def _x430(motor: Motor, velocity: int, current: int = 1193, p: int = 800) -> ModelFacts:
    """Describe an XM, XH, XD or XW model, including the 540 series. velocity, current: factory limits [ticks]."""
    differs = {"Velocity Limit": _Facts(velocity, (0, 1023)), "Current Limit": _Facts(current, (0, current))}
    return ModelFacts(motor, differs | _gains(p=p))


_FIRMWARE_52 = (52, ((168, 208, 20),))
"""Indirect data of the 330 series. Sources contradict each other for firmware before 52.

dynamixel-sdk 4.1 and ROBOTIS' dynamixel_hardware_interface (pull request 69) have two control tables: one with the data
at 224, and one named fw52, with the data at 208. The e-Manual (2026-09) says: "Firmware versions prior to V53 support
up to 20 Indirect Address/Data items [...] for Indirect Data is 208 ~ 227"; later versions have 28 items at 224. All
sources agree on 208 for firmware 52. For earlier firmware, the fake uses 224 like ROBOTIS' own programs, which would
otherwise read zeros.
"""


def _x330(motor: Motor, velocity: int, current: int, differs: Mapping[str, RegisterFacts]) -> ModelFacts:
    common = {
        "Baud Rate": _Facts(1, (0, 6)),
        "Temperature Limit": _Facts(70, (0, 100)),
        "Velocity Limit": _Facts(velocity, (0, 2047)),
        "Current Limit": _Facts(current, (0, current)),
    }
    return ModelFacts(
        motor,
        {**common, **differs},
        current_unit_a=1.0e-3,
        fast_read_firmware=46,
        senses_supply=True,
        indirect=((168, 224, 28),),
        indirect_of_firmware=_FIRMWARE_52,
    )


def _xl330(motor: Motor, velocity: int, gains: Mapping[str, RegisterFacts]) -> ModelFacts:
    return _x330(motor, velocity, 1750, {**_volts(31, 35, 70), "Shutdown": _Facts(53), **gains})


def _xc330(motor: Motor, velocity: int, gains: Mapping[str, RegisterFacts]) -> ModelFacts:
    """Return the specifications of an XC330 model (M: 5 V, T: 12 V)."""
    if motor.voltage_v < _LEAST_OF_T:
        return _x330(motor, velocity, 2352, {**_volts(31, 35, 70), **gains})
    return _x330(motor, velocity, 910, {**_volts(55, 55, 140), "PWM Slope": _Facts(255, (1, 255)), **gains})


def _voltage_driven(motor: Motor, differs: Mapping[str, RegisterFacts]) -> ModelFacts:
    return ModelFacts(motor, differs, current_unit_a=0.0, operating_modes=frozenset({1, 3, 4, 16}))


_LEAST_OF_T = 9.0  # V

FACTS: Mapping[str, ModelFacts] = {
    "XM430-W350": _x430(Motor(12.0, 2.3, 46), 200),
    "XM430-W210": _x430(Motor(12.0, 2.3, 77), 330),
    "XH430-W350": _x430(Motor(12.0, 1.3, 30), 130, 648, p=900),
    "XM540-W270": _x430(Motor(12.0, 4.4, 30), 128, 2047),
    "XL330-M288": _xl330(Motor(5.0, 1.47, 103), 445, _gains(velocity_i=1600, velocity_p=180, p=400)),
    "XC330-T288": _xc330(Motor(11.1, 0.80, 65), 320, _gains(velocity_i=1200, velocity_p=40, p=900)),
    "XL430-W250": _voltage_driven(
        Motor(11.1, 1.3, 57),
        {
            "Temperature Limit": _Facts(72, (0, 100)),
            **_volts(60, 60, 140),
            "Velocity Limit": _Facts(265, (0, 1023)),
            **_gains(velocity_i=1000, d=4000, p=640),
        },
    ),
    "XH430-W210": _x430(Motor(12.0, 1.3, 50), 210, 648, p=900),
    "XD430-T350": _x430(Motor(12.0, 1.3, 30), 130, 648, p=900),
    "XD430-T210": _x430(Motor(12.0, 1.3, 50), 210, 648, p=900),
    "XW430-T333": _x430(Motor(12.0, 1.3, 31), 139, 2047, p=900),
    "XM540-W150": _x430(Motor(12.0, 4.4, 53), 230, 2047),
    "XH540-W270": _x430(Motor(12.0, 4.9, 39), 167, 2047),
    "XH540-W150": _x430(Motor(12.0, 4.9, 70), 300, 2047),
    "XD540-T270": _x430(Motor(12.0, 4.9, 39), 167, 2047),
    "XD540-T150": _x430(Motor(12.0, 4.9, 70), 300, 2047),
    "XW540-T260": _x430(Motor(12.0, 4.9, 40), 167, 2047),
    "XW540-T140": _x430(Motor(12.0, 4.9, 72), 304, 2047),
    "XL330-M077": _xl330(Motor(5.0, 1.47, 383), 1620, _gains(velocity_i=400, velocity_p=40, i=400, p=400)),
    "XC330-T181": _xc330(Motor(11.1, 0.80, 104), 510, _gains(velocity_i=1200, velocity_p=40, p=900)),
    "XC330-M181": _xc330(Motor(5.0, 1.80, 129), 545, _gains(velocity_i=1400, d=500, p=1200)),
    "XC330-M288": _xc330(Motor(5.0, 1.80, 81), 350, _gains(velocity_i=1600, velocity_p=50, d=500, p=1100)),
    "XC430-W150": _voltage_driven(
        Motor(12.0, 1.4, 106),
        {
            **_volts(60, 60, 160),
            "Moving Threshold": _Facts(20, (0, 1023)),
            "Velocity Limit": _Facts(460, (0, 1023)),
            **_gains(p=460),
        },
    ),
    "XC430-W240": _voltage_driven(
        Motor(12.0, 1.4, 70), {**_volts(60, 60, 160), "Velocity Limit": _Facts(306, (0, 1023)), **_gains(p=700)}
    ),
}
"""All X-series models with a single 5 to 12 V motor and a model number in the SDK."""

COMMON_INITIAL: Mapping[str, int] = {
    "ID": 1,
    "Baud Rate": 1,
    "Secondary(Shadow) ID": 255,
    "Secondary ID": 255,
    "Status Return Level": 2,
}
"""Factory values of every Protocol 2.0 servo whose ranges are unknown here."""

_X_INITIAL = {
    "Return Delay Time": 250,
    "Operating Mode": 3,
    "Protocol Type": 2,
    "Moving Threshold": 10,
    "PWM Limit": 885,
    "Max Position Limit": 4095,
    "Shutdown": 52,
}

X_INITIAL: Mapping[str, Mapping[str, int]] = {
    "2XL430-W250": _X_INITIAL
    | {"Temperature Limit": 72, "Max Voltage Limit": 140, "Min Voltage Limit": 60, "Velocity Limit": 250},
    "2XC430-W250": _X_INITIAL
    | {"Temperature Limit": 80, "Max Voltage Limit": 160, "Min Voltage Limit": 60, "Velocity Limit": 275},
    "XH430-V210": _X_INITIAL,
    "XH430-V350": _X_INITIAL,
    "XH540-V150": _X_INITIAL,
    "XH540-V270": _X_INITIAL,
    "XW540-H260": _X_INITIAL,
}
"""Factory values in the EEPROM of X models whose ranges are unknown here. For the 24 V models, only values that all of
them share are given.
"""

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
