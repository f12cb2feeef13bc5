"""The geometry of a serial arm: the placement of its joints. Everything else is identified."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ModelError, ShapeError

MOST_JOINTS = 7
LINK_TERMS = (
    *("mass", "moment_x", "moment_y", "moment_z"),
    *("inertia_xx", "inertia_xy", "inertia_xz", "inertia_yy", "inertia_yz", "inertia_zz"),
)
"""Inertial parameters of a link in its own frame: mass [kg], mass times centre of mass [kg m], inertia about the
frame's origin [kg m^2].
"""
SAME = 0.9  # cosine of the angle between two directions of gravity above which they count as the same
UNITS = {"mass": "kg", "moment": "kg m", "inertia": "kg m^2", "armature": "kg m^2"}


@dataclass(frozen=True)
class Chain:
    """A serial chain of revolute joints.

    Link i's frame is attached to the link, at joint i. At angle zero it is located at `translation[i]` with orientation
    `rotation[i]` in the frame of the previous link (for the first link, of the base).

    Raises ShapeError for incompatible arrays, ModelError for too many joints and for invalid rotations and axes.
    """

    rotation: Array
    """Orientation of each link's frame in that of the previous link, at angle zero (joints, 3, 3)."""
    translation: Array
    """Origin of each link's frame in that of the previous link (joints, 3) [m]."""
    axis: Array
    """Unit vector along the axis of each joint, in its link's frame (joints, 3)."""
    gravity: Array
    """Gravity in the base's frame (3,) [m/s^2]; (0, 0, -9.81) for an upright base."""

    def __post_init__(self) -> None:
        joints = len(self.axis)
        shapes = self.rotation.shape, self.translation.shape, self.axis.shape, self.gravity.shape
        if shapes != ((joints, 3, 3), (joints, 3), (joints, 3), (3,)):
            raise ShapeError(
                f"rotation, translation, axis and gravity have the shapes {', '.join(map(str, shapes))}: they must be "
                "(joints, 3, 3), (joints, 3), (joints, 3) and (3,)"
            )
        if not 1 <= joints <= MOST_JOINTS:
            raise ModelError(f"the chain has {joints} joints; it must have 1 to {MOST_JOINTS}")
        if np.abs(np.linalg.norm(self.axis, axis=1) - 1.0).max() > 1e-6:
            raise ModelError("the joints' axes must have length 1")
        turned = self.rotation @ np.swapaxes(self.rotation, 1, 2)
        if np.abs(turned - np.eye(3)).max() > 1e-6 or np.any(np.linalg.det(self.rotation) < 0.0):
            raise ModelError("rotation must contain proper rotation matrices")

    @property
    def joints(self) -> int:
        return len(self.axis)

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Rotation, translation, axis and gravity in the form that the compiled code needs."""
        given = self.rotation, self.translation, self.axis, self.gravity
        rotation, translation, axis, gravity = (np.ascontiguousarray(each, dtype=np.float64) for each in given)
        return rotation, translation, axis, gravity


def directions_of_gravity(assumed: Array) -> Iterator[Array]:
    """Yield other directions that gravity may have in the base's frame (3,) [m/s^2]: reversed, then along its axes.

    assumed: gravity as described (3,) [m/s^2]; without gravity, nothing is yielded.
    """
    size = float(np.linalg.norm(assumed))
    tried = [assumed]
    for each in (-assumed, *(-size * np.eye(3)), *(size * np.eye(3))):
        if all(float(each @ other) < SAME * size**2 for other in tried):
            tried.append(each)
            yield each


def parameter_names(joints: int) -> tuple[str, ...]:
    """Return the names of all inertial parameters.

    For each link, these are the terms in LINK_TERMS and `armature`, the rotor's inertia times the gear ratio squared.
    """
    return tuple(f"{term}_{joint + 1}" for joint in range(joints) for term in (*LINK_TERMS, "armature"))


def unit_of(name: str) -> str:
    return UNITS[name.partition("_")[0]]
