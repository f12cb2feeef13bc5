"""Check, before torque is on, that the two servos of one joint do not contradict their configured directions."""

import math
from collections.abc import Iterator

from hil.config.schema import Config
from hil.drivers.bus import ServoBus

__all__ = ["mirrored_pairs"]

_DISAGREE_RAD, _AGREE_RAD = 0.5, 0.25
"""If the angles of two servos differ by more than the first value, they contradict each other; if they differ by less
than the second, they agree.
"""


def mirrored_pairs(config: Config, bus: ServoBus) -> Iterator[str]:
    """Yield one sentence for each joint whose servos have the same direction although they read as mirror images.

    The second servo's horn may be mounted at any angle, so a difference alone proves nothing. But two servos on one
    joint rarely turn the same way, and two that do are unlikely to read as mirror images by chance. Raises the errors
    of `Servo.read`.
    """
    for index, (described, joint) in enumerate(zip(config.joints, bus.joints, strict=True)):
        if len(described.ids) == 1 or len(set(described.directions)) > 1:
            continue
        first, second = bus.read_drives(index)
        apart, mirrored = (math.remainder(each - first, math.tau) for each in (second, -second))
        if abs(apart) > _DISAGREE_RAD and abs(mirrored) < _AGREE_RAD:
            sign = described.direction
            yield (
                f"{joint.title}: with direction = {list(described.directions)} and zero_ticks = "
                f"{described.zero_ticks}, its servos read {first:+.2f} and {second:+.2f} rad, mirror images of each "
                "other, so they would work against each other under torque. They face each other: set direction = "
                f"{[sign, -sign]}. If they do turn the same way, move the second servo's horn, or set its Homing "
                "Offset, so that both read the same angle."
            )
