"""Which registers hang together, and why a servo refuses a write to one of them."""

from typing import TYPE_CHECKING

from drivers.packet import StatusError
from fakes.controller import POSITION_MODE
from fakes.registers import TICKS_PER_TURN, Register

if TYPE_CHECKING:
    from fakes.servo import Servo

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

_MULTI_TURN_LIMIT_TICKS = 256 * TICKS_PER_TURN


def refusal(servo: "Servo", register: Register, value: int) -> int:
    """Why this value may not be written to this register now; 0 when it may."""
    name = register.name
    if not register.writable or (register.eeprom and servo.torque_enabled):
        return StatusError.ACCESS
    in_range = register.minimum <= value <= register.maximum
    known = bool(servo.model.operating_modes)
    if name == "Operating Mode" and known:
        in_range = value in servo.model.operating_modes
    if servo.watchdog_tripped and (name in GOALS or (name == "Bus Watchdog" and value != 0)):
        in_range = False
    if not in_range:
        return StatusError.DATA_RANGE
    return StatusError.NONE if not known or _within_limit(servo, name, value) else StatusError.DATA_LIMIT


def _within_limit(servo: "Servo", name: str, value: int) -> bool:
    if name in LIMIT_OF_GOAL:
        return abs(value) <= servo.value(LIMIT_OF_GOAL[name])
    if name != "Goal Position":
        return True
    if servo.operating_mode == POSITION_MODE:
        return servo.value("Min Position Limit") <= value <= servo.value("Max Position Limit")
    return abs(value) < _MULTI_TURN_LIMIT_TICKS
