"""A serial arm as a file describes it: joints in space and the rigid bodies between them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ArmFileError(ValueError):
    """A description of an arm cannot be read or does not describe a serial arm. The message names the file, the element
    and what is
    required."""


@dataclass(frozen=True)
class Body:
    """A rigid body in the frame of the link that it is part of."""

    mass: float
    """[kg]."""
    centre: Array
    """Centre of mass (3,) [m]."""
    inertia: Array
    """About the centre of mass (3, 3) [kg m^2]."""

    @classmethod
    def nothing(cls) -> "Body":
        """A body without mass."""
        return cls(0.0, np.zeros(3), np.zeros((3, 3)))

    def moved(self, rotation: Array, translation: Array) -> "Body":
        """Expressed in a frame in which its own frame has this rotation and translation."""
        return Body(self.mass, rotation @ self.centre + translation, rotation @ self.inertia @ rotation.T)

    def joined(self, other: "Body") -> "Body":
        """The two bodies, given in the same frame, as one."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Body(0.0, self.centre, self.inertia + other.inertia)
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        inertia = np.zeros((3, 3))
        for body in (self, other):
            inertia += body.inertia + body.mass * _steiner(body.centre - centre)
        return Body(mass, centre, inertia)

    @property
    def parameters(self) -> Array:
        """Mass, first moment, and inertia about the frame's origin (xx, xy, xz, yy, yz, zz) (10,)."""
        about = self.inertia + self.mass * _steiner(self.centre)
        upper = [about[row, column] for row in range(3) for column in range(row, 3)]
        return np.array([self.mass, *(self.mass * self.centre), *upper])

    @property
    def is_physical(self) -> bool:
        """Whether some distribution of mass has this inertia: positive, and no principal moment above the others'
        sum."""
        if not self.mass > 0.0:
            return False
        moments = np.linalg.eigvalsh(self.inertia)
        return bool(moments[0] >= -1e-12 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-6) + 1e-12)


@dataclass(frozen=True)
class ArmJoint:
    """A revolute joint and the link that it moves."""

    name: str
    link: str
    """Name of the link that it moves."""
    rotation: Array
    """Of the link's frame in that of the moving link before, at angle zero (3, 3)."""
    translation: Array
    """(3,) [m]."""
    axis: Array
    """In the link's frame, of length 1 (3,)."""
    limits: tuple[float, float] | None
    """[rad]; None for a joint that turns on and on."""
    body: Body
    """The link with all that is fixed to it."""
    fixed: tuple[str, ...]
    """Names of the links that are fixed to it, or held."""


@dataclass(frozen=True)
class ArmDescription:
    """A serial arm."""

    path: Path
    base: str
    """Name of the link that stands still."""
    joints: tuple[ArmJoint, ...]
    held: tuple[str, ...]
    """Movable joints that are not among the arm's, such as a gripper's: taken as held at zero."""
    doubts: tuple[str, ...]
    """In words: what is implausible about its inertias."""

    @property
    def parameters(self) -> Array:
        """`Body.parameters` of each link (joints, 10)."""
        return np.stack([joint.body.parameters for joint in self.joints])

    @property
    def geometry(self) -> tuple[Array, Array, Array]:
        """Rotations (joints, 3, 3), translations (joints, 3) [m] and axes (joints, 3)."""
        rotation, translation, axis = (
            np.stack([getattr(joint, name) for joint in self.joints]) for name in ("rotation", "translation", "axis")
        )
        return rotation, translation, axis


def _steiner(offset: Array) -> Array:
    """What a unit mass at this offset adds to an inertia (3, 3)."""
    shifted: Array = np.dot(offset, offset) * np.eye(3) - np.outer(offset, offset)
    return shifted
