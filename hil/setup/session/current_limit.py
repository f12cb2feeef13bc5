"""Conversion of a current limit to the ticks of the Current Limit register."""

import math

from hil.drivers.joint import Joint


def current_limit_ticks(joint: Joint, limit: float) -> int:
    """The smallest Current Limit [ticks] with which the joint's servo accepts every goal up to `limit` [A]."""
    return math.ceil(limit / abs(joint.drive_unit(0.0)) - 1e-9)
