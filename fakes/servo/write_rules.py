"""Dependencies between registers, and reasons for refusing a write."""

from hil.drivers.packet import StatusError
from hil.fakes.servo.controller import POSITION_MODE
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.registers import TICKS_PER_TURN, EmulatedModel, Register, allowed_values

GOALS = frozenset({"Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"})

LIMIT_OF_GOAL = {"Goal PWM": "PWM Limit", "Goal Current": "Current Limit", "Goal Velocity": "Velocity Limit"}

GAINS = (
    "Velocity I Gain",
    "Velocity P Gain",
    "Position D Gain",
    "Position I Gain",
    "Position P Gain",
    "Feedforward 2nd Gain",
    "Feedforward 1st Gain",
)

PROFILE = ("Profile Acceleration", "Profile Velocity")

WATCHDOG_TRIPPED = 0xFF

_MULTI_TURN_LIMIT_TICKS = 256 * TICKS_PER_TURN


def refusal(memory: Memory, model: EmulatedModel, register: Register, value: int, shadow: bool = False) -> int:
    """Return the error number for writing this value to this register; 0 if the write is permitted.

    shadow: whether the write was addressed to the Secondary ID; such a write cannot change the EEPROM.
    """
    name = register.name
    if not register.writable or (register.eeprom and (shadow or memory.get("Torque Enable"))):
        return StatusError.ACCESS
    in_range = value in allowed_values(model, register)
    known = bool(model.operating_modes)
    watchdog_tripped = memory.get("Bus Watchdog") == WATCHDOG_TRIPPED
    if watchdog_tripped and (name in GOALS or (name == "Bus Watchdog" and value != 0)):
        in_range = False
    if not in_range:
        return StatusError.DATA_RANGE
    return StatusError.NONE if not known or _within_limit(memory, name, value) else StatusError.DATA_LIMIT


def _within_limit(memory: Memory, name: str, value: int) -> bool:
    if name in LIMIT_OF_GOAL:
        return abs(value) <= memory.value(LIMIT_OF_GOAL[name])
    if name != "Goal Position":
        return True
    if memory.get("Operating Mode") == POSITION_MODE:
        return memory.value("Min Position Limit") <= value <= memory.value("Max Position Limit")
    return abs(value) < _MULTI_TURN_LIMIT_TICKS
