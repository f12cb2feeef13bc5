"""Units and motor data of each servo model, which the SDK's control tables leave out.

Sources: ROBOTIS e-Manual, page of each model (current unit, resolution, Operating Mode, stall figures). None of the
torque constants below was measured in this project.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import NamedTuple

from hil.drivers.errors import UnknownModel

__all__ = [
    "BAUD_RATES",
    "FULL_PWM_TICKS",
    "RETURN_DELAY_UNIT",
    "SERVO_MODELS",
    "VELOCITY_UNIT",
    "VOLTAGE_UNIT",
    "WATCHDOG_UNIT",
    "Mode",
    "NoLoad",
    "Published",
    "ServoModel",
    "Stall",
    "servo_model",
]

VELOCITY_UNIT = 0.229 * 2 * math.pi / 60
"""Velocity per tick of Present Velocity [rad/s]."""

WATCHDOG_UNIT = 0.020
"""Time per tick of Bus Watchdog [s]."""

RETURN_DELAY_UNIT = 2e-6
"""Time per tick of Return Delay Time [s]."""

VOLTAGE_UNIT = 0.1
"""Voltage per tick of Present Input Voltage [V]."""

FULL_PWM_TICKS = 885
"""Goal PWM that applies the whole supply voltage to the motor [ticks]."""

LEAST_SUPPLY = 0.6
"""A voltage across a motor counts as the full supply voltage if it is at least this fraction of the lowest published
supply voltage: supplies sag, and resistance and no-load speed differ by tens of percent from servo to servo.
"""

LEAST_OF_MEASURED = 0.75
"""Replaces `LEAST_SUPPLY` if the supply was measured. It is less than 1 because motors differ and the supply may sag
between two readings.
"""

HARDLY_ANY, LEAST_SUPPLY_AT_NO_LOAD = 0.2, 0.85
"""If the current is below the first value, a fraction of the goal, torque may simply be off. In that case, the second
value replaces `LEAST_OF_MEASURED` and `LEAST_SUPPLY`.
"""

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates, indexed by the value of the register Baud Rate. The 330 models only go up to 4 MBd."""


class Mode(IntEnum):
    """How a joint is driven: the value of Operating Mode. A goal is a current [A], or a voltage [V] in PWM mode."""

    CURRENT = 0
    PWM = 16

    @property
    def goal_unit(self) -> str:
        return "A" if self is Mode.CURRENT else "V"

    @property
    def goal_register(self) -> str:
        """Name of the register that holds the goal."""
        return "Goal Current" if self is Mode.CURRENT else "Goal PWM"


class Stall(NamedTuple):
    """One row of the e-Manual's stall figures: voltage [V], current [A], torque at the output shaft [N m]."""

    voltage: float
    current: float
    torque: float


class NoLoad(NamedTuple):
    """The e-Manual's no-load speed: voltage [V], speed of the output shaft [rad/s]."""

    voltage: float
    speed: float


class Published(NamedTuple):
    """A published torque constant: the median, lowest and highest of the published values.

    The constant is uncertain even where the published values agree, since an individual servo can deviate from them by
    tens of percent. If that matters, measure the constant with a known weight.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class ServoModel:
    """Units and limits of one servo model.

    current_unit: current per tick of Goal and Present Current [A]; None if the model has neither current mode nor
    sensor.
    stalls: the e-Manual's stall figures.
    no_load: the e-Manual's no-load speed at the nominal voltage.
    other_constants: further published torque constants [N m/A].
    position_steps: ticks of Present Position per turn.
    min_voltage: supply voltage below which the servo shuts down with factory settings (Min Voltage Limit) [V].
    watchdog_firmware: first firmware with a Bus Watchdog.
    fast_sync_read_firmware: first firmware that supports Fast Sync Read; None if the model never supports it.
    senses_supply: whether Present Current is the supply current, that is, the motor current times the bridge's duty
    cycle, which is far less than the commanded current while the joint moves slowly. This is true of the 330 series
    (e-Manual, Current Limit: the XL330 "measures current at its input power source").
    """

    name: str
    current_unit: float | None
    stalls: tuple[Stall, ...]
    no_load: NoLoad
    other_constants: tuple[float, ...] = ()
    position_steps: int = 4096
    min_voltage: float = 9.5
    watchdog_firmware: int = 38
    fast_sync_read_firmware: int | None = 45
    senses_supply: bool = False

    @property
    def position_unit(self) -> float:
        """Angle per tick of Present Position [rad]."""
        return 2 * math.pi / self.position_steps

    @property
    def default_mode(self) -> Mode:
        """Current mode if the servo has it, otherwise PWM mode."""
        return Mode.PWM if self.current_unit is None else Mode.CURRENT

    @property
    def resistance(self) -> float:
        """Resistance between the motor's terminals [Ohm]: the lowest value among the stall figures."""
        return min(stall.voltage / stall.current for stall in self.stalls)

    @property
    def back_emf(self) -> float:
        """Back-EMF per velocity of the output shaft [V s/rad]."""
        return self.no_load.voltage / self.no_load.speed

    def is_out_of_voltage(self, goal: float, carried: float, velocity: float, supply: float = math.nan) -> bool:
        """Whether a current falls short of its goal because the voltage is too low to drive it through the turning
        motor.

        This is taken as the cause if the motor turns in the direction of its goal and the voltage across its terminals
        (voltage drop of the winding plus back-EMF) is about the supply voltage.

        goal, carried: commanded and measured current [A]. velocity: velocity of the output shaft [rad/s]. supply:
        lowest measured voltage of the supply [V]; NaN if unknown, in which case the lowest plausible voltage is
        assumed.
        """
        if goal == 0.0 or velocity * goal <= 0.0 or not abs(carried) < abs(goal):
            return False
        along = math.copysign(1.0, goal) * carried
        if along < -HARDLY_ANY * abs(goal):
            return False  # for lack of voltage a current falls short of its goal, but never reverses
        along = max(0.0, along)
        back_emf = self.back_emf * abs(velocity)
        has_current = along > HARDLY_ANY * abs(goal)
        if supply > 0.0:
            # The published stall figures of one model differ by up to a factor of two: the weakest motor counts.
            weakest = max(stall.voltage / stall.current for stall in self.stalls)
            across = weakest * along + back_emf
            return across >= (LEAST_OF_MEASURED if has_current else LEAST_SUPPLY_AT_NO_LOAD) * supply
        least = LEAST_SUPPLY if has_current else LEAST_SUPPLY_AT_NO_LOAD
        return self.resistance * along + back_emf >= least * min(stall.voltage for stall in self.stalls)

    @property
    def torque_per_ampere(self) -> Published:
        """Torque constant at the output shaft [N m/A]: stall torque over stall current, and other published values."""
        return _spread([stall.torque / stall.current for stall in self.stalls] + list(self.other_constants))

    @property
    def torque_per_volt(self) -> Published:
        """Torque at the output shaft per volt at standstill [N m/V]: stall torque divided by supply voltage.

        In PWM mode, the motor torque is this value times the applied voltage, minus the effect of back-EMF, which the
        identified viscous friction then includes.
        """
        return _spread([stall.torque / stall.voltage for stall in self.stalls])


def _spread(values: list[float]) -> Published:
    low, high = min(values), max(values)
    return Published(sorted(values)[len(values) // 2], low, high)


_WORKBENCH_XM430 = 1 / (149.795 * 2.69e-3)
# From ROBOTIS' dynamixel-workbench: 149.795 ticks per N m for the whole XM family, hence 2.48 N m/A.


def _no_load(voltage: float, rpm: float) -> NoLoad:
    return NoLoad(voltage, rpm * 2 * math.pi / 60)


_MODELS = (
    ServoModel(
        "XM430-W350",
        2.69e-3,
        (Stall(11.1, 2.1, 3.8), Stall(12.0, 2.3, 4.1), Stall(14.8, 2.7, 4.8)),
        _no_load(12.0, 46.0),
        (_WORKBENCH_XM430,),
    ),
    ServoModel(
        "XM430-W210",
        2.69e-3,
        (Stall(11.1, 2.1, 2.7), Stall(12.0, 2.3, 3.0), Stall(14.8, 2.7, 3.7)),
        _no_load(12.0, 77.0),
    ),
    ServoModel(
        "XH430-W350",
        2.69e-3,
        (Stall(11.1, 1.2, 3.1), Stall(12.0, 1.3, 3.4), Stall(14.8, 1.5, 4.2)),
        _no_load(12.0, 30.0),
    ),
    ServoModel(
        "XH430-W210",
        2.69e-3,
        (Stall(11.1, 1.2, 2.2), Stall(12.0, 1.3, 2.5), Stall(14.8, 1.5, 3.1)),
        _no_load(12.0, 50.0),
    ),
    ServoModel(
        "XM540-W270",
        2.69e-3,
        (Stall(11.1, 4.2, 10.0), Stall(12.0, 4.4, 10.6), Stall(14.8, 5.5, 12.9)),
        _no_load(12.0, 30.0),
    ),
    ServoModel(
        "XM540-W150",
        2.69e-3,
        (Stall(11.1, 4.2, 6.9), Stall(12.0, 4.4, 7.3), Stall(14.8, 5.5, 8.9)),
        _no_load(12.0, 53.0),
    ),
    ServoModel(
        "XL330-M288",
        1.0e-3,
        (Stall(3.7, 1.11, 0.42), Stall(5.0, 1.47, 0.52), Stall(6.0, 1.74, 0.60)),
        _no_load(5.0, 103.0),
        min_voltage=3.5,
        fast_sync_read_firmware=46,
        senses_supply=True,
    ),
    ServoModel(
        "XL330-M077",
        1.0e-3,
        (Stall(3.7, 1.11, 0.180), Stall(5.0, 1.47, 0.215), Stall(6.0, 1.74, 0.228)),
        _no_load(5.0, 383.0),
        min_voltage=3.5,
        fast_sync_read_firmware=46,
        senses_supply=True,
    ),
    ServoModel(
        "XC330-T288",
        1.0e-3,
        (Stall(9.0, 0.61, 0.76), Stall(11.1, 0.80, 0.92), Stall(12.0, 0.88, 1.00)),
        _no_load(11.1, 65.0),
        min_voltage=5.5,
        fast_sync_read_firmware=46,
        senses_supply=True,
    ),
    ServoModel(
        "XL430-W250",
        None,
        (Stall(9.0, 1.0, 1.0), Stall(11.1, 1.3, 1.4), Stall(12.0, 1.4, 1.5)),
        _no_load(11.1, 57.0),
        min_voltage=6.0,
    ),
)

SERVO_MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _MODELS})
"""The supported servo models, by name."""


_READ_WITH_A_VOWEL = tuple("AEFHILMNORSXu")  # "ex", "em"; and "unknown"


def servo_model(name: str) -> ServoModel:
    """Return the model with this name; raises UnknownModel, listing the supported names."""
    try:
        return SERVO_MODELS[name]
    except KeyError:
        raise UnknownModel(f"{name!r} is not a supported servo model. Supported: {', '.join(SERVO_MODELS)}.") from None


def with_article(name: str) -> str:
    """Return a model name preceded by "a" or "an", as it is read aloud: "an XM430-W350", "a PH42"."""
    return f"{'an' if name[:1] in _READ_WITH_A_VOWEL else 'a'} {name}"


def fastest_no_load() -> float:
    """Return the no-load speed of the fastest model [rad/s]."""
    return max(model.no_load.speed for model in _MODELS)
