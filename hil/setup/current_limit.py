"""The ticks of Current Limit that a joint needs."""

import math

from hil.drivers.joint import Joint


def current_limit_ticks(joint: Joint, limit: float) -> int:
    """The least Current Limit of the joint's servo that takes every goal within `limit` [A]."""
    return math.ceil(limit / abs(joint.drive_unit(0.0)) - 1e-9)
