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
from hil.drivers.servo_model import Mode


@contextmanager
def servo_limits(config: Config, bus: ServoBus, note: Callable[[str], None]) -> Iterator[None]:
    """Inside the block the servos take no more than `current_limit`; enter and leave it with torque off.

    Raises WrongSetting where a servo takes less than the configuration wants, which would silently refuse goals.
    A servo whose former limit cannot be restored is named in a note.
    """
    former: dict[Joint, int] = {}
    try:
        for joint, described in zip(bus.joints, config.joints, strict=True):
            if joint.mode is Mode.CURRENT:
                _lower(config, bus, joint, described.goal_limit, former)
        yield
    finally:
        for joint, ticks in former.items():
            try:
                bus.servo(joint).write("Current Limit", ticks)
            except DriverError as error:
                note(f"{joint}: Current Limit could not be put back to {ticks}: {error}")


def _lower(config: Config, bus: ServoBus, joint: Joint, limit: float, former: dict[Joint, int]) -> None:
    needed = math.ceil(limit / abs(joint.drive_unit(0.0)) - 1e-9)
    servo = bus.servo(joint)
    present = servo.read("Current Limit")
    if present < needed:
        raise WrongSetting(
            f"{joint.title}: its Current Limit is {present}, but current_limit = {limit:g} A needs {needed}; larger "
            "goals would be refused without a word. Set current_limit to "
            f"{present * abs(joint.drive_unit(0.0)):.3g} or less, or "
            "raise the register with DYNAMIXEL Wizard 2.0."
        )
    if present > needed and config.safety.write_current_limit:
        former[joint] = present
        servo.write("Current Limit", needed)
