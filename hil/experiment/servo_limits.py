"""Compare the servos' own current and PWM limits with the configuration, and lower their Current Limit for the run.

A servo with a lowered Current Limit refuses larger goals, even if this program fails. The session restores the limit.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.servo_model import FULL_PWM_TICKS, VOLTAGE_UNIT, Mode


@contextmanager
def servo_limits(config: Config, bus: ServoBus, note: Callable[[str], None]) -> Iterator[None]:
    """Lower the servos' Current Limit to `current_limit`. Torque must be off.

    Raises WrongSetting if a servo allows less than the configuration needs: it would silently refuse larger goals.
    """
    for joint, described in zip(bus.joints, config.joints, strict=True):
        if joint.mode is Mode.CURRENT:
            _lower(config, bus, joint, described.goal_limit, note)
            _check_pwm_limit(bus, joint, described.goal_limit)
    yield


def _lower(config: Config, bus: ServoBus, joint: Joint, limit: float, note: Callable[[str], None]) -> None:
    servos = bus.servos(joint)
    needed = joint.current_limit_ticks(limit / len(servos))  # they share the goal
    for servo in servos:
        present = servo.read("Current Limit")
        if present < needed:
            raise WrongSetting(
                f"{servo.title}: its Current Limit is {present}, but current_limit = {limit:g} A needs {needed}; "
                "the servo would silently refuse larger goals. Set current_limit to "
                f"{present * len(servos) * abs(joint.drive_unit(0.0)):.3g} or less, or "
                "raise the register with DYNAMIXEL Wizard 2.0."
            )
        if present > needed and config.safety.write_current_limit:
            servo.write("Current Limit", needed)
            note(f"{servo.title}: Current Limit {present} -> {needed} until the end of the run")


def _check_pwm_limit(bus: ServoBus, joint: Joint, limit: float) -> None:
    """Check PWM Limit, which bounds the voltage in current mode too: it must allow `limit` [A] in a motor at rest."""
    servos = bus.servos(joint)
    needed = limit / len(servos) * joint.servo.resistance
    for servo in servos:
        pwm = servo.read("PWM Limit")
        volts = VOLTAGE_UNIT * servo.read("Present Input Voltage") * pwm / FULL_PWM_TICKS
        if volts < needed:
            raise WrongSetting(
                f"{servo.title}: its PWM Limit is {pwm} of {FULL_PWM_TICKS}, {volts:.1f} V at this supply; "
                f"current_limit = {limit:g} A needs {needed:.1f} V, so the motor could not reach the commanded "
                "current. Raise PWM Limit with DYNAMIXEL Wizard 2.0, or lower current_limit."
            )
