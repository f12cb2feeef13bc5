"""A serial arm as described by a file: joints in space and the rigid bodies between them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ArmFileError(ValueError):
    """Raised if a file cannot be read or does not describe a serial arm; the message names the file and the element."""


@dataclass(frozen=True)
class Body:
    """A rigid body in the frame of the link that it belongs to."""

    mass: float
    """Mass [kg]."""
    centre: Array
    """Centre of mass (3,) [m]."""
    inertia: Array
    """Inertia about the centre of mass (3, 3) [kg m^2]."""

    @classmethod
    def nothing(cls) -> "Body":
        return cls(0.0, np.zeros(3), np.zeros((3, 3)))

    def moved(self, rotation: Array, translation: Array) -> "Body":
        """Express the body in another frame; rotation (3, 3) and translation (3,) [m] give the pose of the present
        frame in the new one.
        """
        return Body(self.mass, rotation @ self.centre + translation, rotation @ self.inertia @ rotation.T)

    def joined(self, other: "Body") -> "Body":
        """Merge two bodies given in the same frame."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Body(0.0, self.centre, self.inertia + other.inertia)
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        inertia = np.zeros((3, 3))
        for body in (self, other):
            inertia += body.inertia + body.mass * steiner(body.centre - centre)
        return Body(mass, centre, inertia)

    @property
    def parameters(self) -> Array:
        """Inertial parameters (10,): mass [kg], first moment [kg m], inertia about the frame's origin [kg m^2].

        The inertia is in the order xx, xy, xz, yy, yz, zz.
        """
        about = self.inertia + self.mass * steiner(self.centre)
        upper = [about[row, column] for row in range(3) for column in range(row, 3)]
        return np.array([self.mass, *(self.mass * self.centre), *upper])

    @property
    def is_physical(self) -> bool:
        """Whether a real body can have this inertia: no principal moment is negative or larger than the sum of the
        other two.
        """
        if not self.mass > 0.0:
            return False
        moments = np.linalg.eigvalsh(self.inertia)
        return bool(moments[0] >= -1e-12 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-6) + 1e-12)


MOST_LINKS = 500
"""Maximum number of links in a description: no real arm has this many, and the tree is traversed recursively."""


def check_size(links: int, path: Path) -> None:
    """Raise ArmFileError if a description has more than `MOST_LINKS` links."""
    if links > MOST_LINKS:
        raise ArmFileError(f"{path} has {links} links; at most {MOST_LINKS} are allowed")


@dataclass(frozen=True)
class ArmJoint:
    """A revolute joint and the link that it moves."""

    name: str
    link: str
    """Name of the link that the joint moves."""
    rotation: Array
    """Rotation of the link's frame in the frame of the previous moving link, at angle zero (3, 3)."""
    translation: Array
    """Translation of the link's frame in the frame of the previous moving link (3,) [m]."""
    axis: Array
    """Unit vector along the joint axis, in the link's frame (3,)."""
    limits: tuple[float, float] | None
    """Lower and upper limit [rad]; None for a continuous joint."""
    body: Body
    """The link merged with everything that is rigidly attached to it."""
    fixed: tuple[str, ...]
    """Names of the links attached to this joint's link by fixed or held joints."""
    movable: Mapping[str, Body] = field(default_factory=dict)
    """Bodies of the links in `fixed` that are attached by held joints, keyed by link name, in the frame of this joint's
    link. Each body excludes the links attached to it.
    """


@dataclass(frozen=True)
class ArmDescription:
    """A serial arm."""

    path: Path
    base: str
    """Name of the stationary link."""
    joints: tuple[ArmJoint, ...]
    held: tuple[str, ...]
    """Movable joints outside the arm, such as a gripper's, which are assumed to be held at zero."""
    doubts: tuple[str, ...]
    """Warnings about implausible inertias and about effects that are not modelled, one sentence each."""
    gravity: tuple[float, float, float] | None = None
    """Gravity in the base's frame as given in the file [m/s^2]; None if it is not given or is the format's default."""

    @property
    def parameters(self) -> Array:
        """Inertial parameters of each link (joints, 10), in the form of `Body.parameters`."""
        return np.stack([joint.body.parameters for joint in self.joints])

    @property
    def geometry(self) -> tuple[Array, Array, Array]:
        """Rotations (joints, 3, 3), translations (joints, 3) [m] and axes (joints, 3)."""
        rotation, translation, axis = (
            np.stack([getattr(joint, name) for joint in self.joints]) for name in ("rotation", "translation", "axis")
        )
        return rotation, translation, axis


def steiner(offset: Array) -> Array:
    """Inertia (3, 3) [m^2] added by a unit mass at this offset (3,) [m], by the parallel-axis theorem."""
    shifted: Array = np.dot(offset, offset) * np.eye(3) - np.outer(offset, offset)
    return shifted
