"""Check whether the planar model, with its angle convention, applies to an arm described in a file."""

import numpy as np

from hil.description.arm import ArmDescription, Array

PLANAR_JOINTS = 2
ALIGNED = 1e-3  # rad: directions closer than this count as the same


def is_planar(arm: ArmDescription, gravity: Array) -> bool:
    """Whether the planar model applies to the arm: one or two joints with parallel axes.

    With gravity, the axes must also be horizontal. At angle zero the first link must be horizontal, and positive angles
    must lift it. `gravity`: gravity in the base's frame (3,) [m/s^2].
    """
    if len(arm.joints) > PLANAR_JOINTS:
        return False
    turn, axes, offsets = np.eye(3), [], []
    for joint in arm.joints:
        offsets.append(turn @ joint.translation)
        turn = turn @ joint.rotation
        axes.append(turn @ joint.axis)
    parallel = all(float(axis @ axes[0]) > np.cos(ALIGNED) for axis in axes)
    strength = float(np.linalg.norm(gravity))
    if not parallel or strength == 0.0:
        return parallel
    down = gravity / strength
    if abs(float(axes[0] @ down)) > ALIGNED:
        return False
    return _level(axes[0], _first_link(arm, offsets), down)


def _first_link(arm: ArmDescription, offsets: list[Array]) -> Array:
    """Vector from joint 1 to joint 2, or to the centre of mass of the only link (3,) [m], in the base's frame."""
    first = arm.joints[0]
    return offsets[1] if len(offsets) > 1 else np.asarray(first.rotation @ first.body.centre)


def _level(axis: Array, link: Array, down: Array) -> bool:
    """Whether the component of `link` perpendicular to `axis` is horizontal and is lifted by a positive rotation."""
    across = link - axis * float(axis @ link)
    length = float(np.linalg.norm(across))
    if length == 0.0:
        return False
    lifted = np.cross(axis, across / length)
    return bool(float(lifted @ down) < -np.cos(ALIGNED))
