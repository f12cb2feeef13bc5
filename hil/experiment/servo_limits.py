"""The servos' own limits for one run: read, compared with the configuration, lowered, read back, and restored.

Should this program ever command nonsense, a servo refuses every goal beyond its own Current Limit.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode


@contextmanager
def servo_limits(config: Config, bus: ServoBus, note: Callable[[str], None]) -> Iterator[None]:
    """Inside the block the servos take no more than `current_limit`; enter and leave it with torque off.

    Raises WrongSetting where a servo takes less than the configuration wants, which would silently refuse goals.
    A servo whose former limit cannot be restored is named in a note.
    """
    former: dict[Servo, int] = {}
    try:
        for joint, described in zip(bus.joints, config.joints, strict=True):
            if joint.mode is Mode.CURRENT:
                _lower(config, bus, joint, described.goal_limit, former)
        yield
    finally:
        for servo, ticks in former.items():
            try:
                servo.write("Current Limit", ticks)
            except DriverError as error:
                note(f"{servo.title}: Current Limit could not be put back to {ticks}: {error}")


def _lower(config: Config, bus: ServoBus, joint: Joint, limit: float, former: dict[Servo, int]) -> None:
    servos = bus.servos(joint)
    needed = math.ceil(limit / len(servos) / abs(joint.drive_unit(0.0)) - 1e-9)  # they share the goal
    for servo in servos:
        present = servo.read("Current Limit")
        if present < needed:
            raise WrongSetting(
                f"{servo.title}: its Current Limit is {present}, but current_limit = {limit:g} A needs {needed}; "
                "larger goals would be refused without a word. Set current_limit to "
                f"{present * len(servos) * abs(joint.drive_unit(0.0)):.3g} or less, or "
                "raise the register with DYNAMIXEL Wizard 2.0."
            )
        if present > needed and config.safety.write_current_limit:
            former[servo] = present
            servo.write("Current Limit", needed)
