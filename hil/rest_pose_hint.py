"""Advice for a joint that is not at its configured rest angle."""

import math
from collections.abc import Sequence

__all__ = ["rest_pose_hint", "within_limits"]


def within_limits(position: float, limits: Sequence[float]) -> float:
    """Return `position` if it is within the limits, otherwise the angle a whole number of turns away that is nearest to
    the middle of the limits.

    A servo does not count turns while it is off, so `position`, the angle closest to the rest pose or to zero, may be
    wrong by whole turns. If no such angle is within the limits, the result exceeds them by as little as possible. All
    angles are in rad.
    """
    low, high = limits
    if low <= position <= high:
        return position
    return position - math.tau * round((position - 0.5 * (low + high)) / math.tau)


def rest_pose_hint(position: float, rest: float, tolerance: float, zero_ticks: int) -> str:
    """Return sentences that say why a joint may be away from its rest pose, and what to do.

    Args:
        position: measured angle [rad].
        rest: the joint's angle in arm.rest_pose [rad].
        tolerance: allowed deviation [rad].
        zero_ticks: value of this key that would make the present position the rest pose.
    """
    mirrored = (
        "If this is the first run, check `direction`: with the opposite sign, the joint would be in its rest pose. "
        if abs(-position - rest) <= tolerance
        else "If direction or id is that of another joint, correct it first. "
    )
    return (
        "Move it there by hand: friction may be holding it away from its rest pose, or it may have fallen since an "
        "earlier run. If this configuration has run before, direction and zero_ticks were right then: leave them as "
        "they are. "
        f"{mirrored}Only if it is in its rest pose now, set zero_ticks = {zero_ticks}."
    )
