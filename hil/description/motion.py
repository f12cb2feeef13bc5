"""The pose of an arm according to its description, and how each joint moves it, in words that a person can compare with
the real arm.
"""

import numpy as np

from hil.description.arm import ArmDescription, Array

UPRIGHT = (0.0, 0.0, 1.0)
"""The direction opposite to gravity, in the frame of a base that stands upright."""
LEAST_LEVER = 0.01  # m: if the arm's end is closer to the axis, it has no direction of motion


def end_point(arm: ArmDescription, angles: Array) -> Array:
    """The arm's end (3,) [m] in the base's frame at these angles (joints,) [rad]: the last link's centre of mass."""
    place, turn = _frames(arm, angles)[-1]
    point: Array = place + turn @ arm.joints[-1].body.centre
    return point


def axis_of(arm: ArmDescription, angles: Array, joint: int) -> tuple[Array, Array]:
    """A point on a joint's axis [m] and its direction (3,), in the base's frame."""
    place, turn = _frames(arm, angles)[joint]
    direction: Array = turn @ arm.joints[joint].axis
    return place, direction


def moves(arm: ArmDescription, angles: Array, joint: int, up: Array | tuple[float, float, float] = UPRIGHT) -> str:
    """Describe in words the direction in which an increasing angle of a joint moves or turns the arm's end.

    up: the direction opposite to gravity in the base's frame (3,).
    """
    place, direction = axis_of(arm, angles, joint)
    velocity, up = np.cross(direction, end_point(arm, angles) - place), np.asarray(up)
    if float(np.linalg.norm(velocity)) < LEAST_LEVER:
        axis = _towards(direction, up)
        return f"turns the end about its own axis (pointing {axis}), counter-clockwise as seen from that side"
    return f"moves the end {_towards(velocity, up)}"


def _towards(vector: Array, up: Array) -> str:
    """Name the axis of the base nearest to a vector, and say where this axis points for an observer next to the arm.

    The observer looks along the base's x axis or, if that is vertical, along its z axis.
    """
    upwards = int(np.argmax(np.abs(up)))
    forwards = 0 if upwards != 0 else 2
    left = np.cross(up, np.eye(3)[forwards])
    main = int(np.argmax(np.abs(vector)))
    sign = 1.0 if vector[main] > 0.0 else -1.0
    if main == upwards:
        word = "up" if sign * up[main] > 0.0 else "down"
    elif main == forwards:
        word = "forwards" if sign > 0.0 else "backwards"
    else:
        word = "to the left" if sign * left[main] > 0.0 else "to the right"
    return f"{word} ({'+' if sign > 0.0 else '-'}{'xyz'[main]})"


def _frames(arm: ArmDescription, angles: Array) -> list[tuple[Array, Array]]:
    """For each link: the position of its joint [m] and its rotation, in the base's frame."""
    place, turn, found = np.zeros(3), np.eye(3), []
    for joint, angle in zip(arm.joints, angles.tolist(), strict=True):
        place = place + turn @ joint.translation
        turn = turn @ joint.rotation @ rotation_about(joint.axis, angle)
        found.append((place, turn))
    return found


def rotation_about(axis: Array, angle: float) -> Array:
    """Rotation matrix (3, 3) about `axis` (3,) of length 1 by `angle` [rad]."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turned
