"""What to do about a joint that is not where the configuration says it rests."""

__all__ = ["rest_pose_hint"]


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
