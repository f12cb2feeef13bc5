"""What to do about a joint that is not where the configuration says it rests."""

import math
from collections.abc import Sequence

__all__ = ["rest_pose_hint", "within_limits"]


def within_limits(position: float, limits: Sequence[float]) -> float:
    """Return the angle within the position limits that is a whole number of turns from `position`, if there is one.

    An encoder only measures the angle within one turn. `position` assumes the turn closest to the rest pose, but a
    joint that fell must be at an angle that it can reach. All angles are in rad; `position` is returned unchanged if it
    is within the limits or no other turn is.
    """
    low, high = limits
    inside = [each for turn in (0, -1, 1) if low <= (each := position + turn * math.tau) <= high]
    return inside[0] if inside else position


def rest_pose_hint(position: float, rest: float, tolerance: float, zero_ticks: int) -> str:
    """Return sentences that say what may be wrong.

    Args:
        position: measured angle [rad].
        rest: the joint's angle in arm.rest_pose [rad].
        tolerance: deviation that is allowed [rad].
        zero_ticks: the value that would make the present position the rest pose.
    """
    mirrored = (
        "With the opposite direction it would be at rest: check direction first. "
        if abs(-position - rest) <= tolerance
        else "If direction or id belong to another joint, correct them first. "
    )
    return (
        "Move it there by hand: friction may hold it away from rest. "
        f"{mirrored}Only if it is in its rest pose now, set zero_ticks = {zero_ticks}."
    )
