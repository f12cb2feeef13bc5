"""An identified spatial arm as a model; see `hil.arm_model`. Requires only numpy.

In the Newton-Euler equations, each link has its base parameters instead of its own inertial parameters. Parameters that
were eliminated are zero.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hil.arm_model import ArmModel
from hil.estimator.arrays import Array
from hil.estimator.chain.model.tilt import TILT, tilted

_INERTIA = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))


@dataclass(frozen=True)
class Geometry:
    """Joint geometry, for all joints in order.

    rotation, translation: pose of the joint's frame relative to the previous link's frame at angle zero, (joints, 3, 3)
    and (joints, 3) [m]. axis: joint axis in the joint's frame (joints, 3). gravity: configured gravity in the frame of
    the base (3,) [m/s^2]; an identified tilt is not included.
    """

    rotation: Array
    translation: Array
    axis: Array
    gravity: Array


@dataclass(frozen=True, repr=False)
class ChainArmModel(ArmModel):
    """The dynamics of an identified spatial arm.

    `values` holds its base parameters; `groups` gives, for each of them, the linear combination of link parameters that
    it represents.
    """

    geometry: Geometry
    groups: dict[str, str]

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Mass matrices (..., joints, joints) [kg m^2] in the poses q (..., joints) [rad]."""
        (q,) = self._motion(q=q)
        angles = np.moveaxis(q, -1, 0)
        columns = []
        for joint in range(len(self.joints)):
            unit = np.zeros_like(angles)
            unit[joint] = 1.0
            columns.append(self._torque(angles, np.zeros_like(angles), unit, np.zeros(3)))
        return np.asarray(np.moveaxis(np.stack(columns), (0, 1), (-1, -2)))

    @property
    def base_gravity(self) -> Array:
        """Gravity in the frame of the base (3,) [m/s^2], including the identified tilt."""
        return tilted(self.geometry.gravity, *(self.values.get(name, 0.0) for name in TILT))

    def _rigid_body(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self._torque(q, dq, ddq, self.base_gravity)

    def _gravity(self, q: Array) -> Array:
        nothing = np.zeros_like(q)
        return self._torque(q, nothing, nothing, self.base_gravity)

    def _torque(self, q: Array, dq: Array, ddq: Array, gravity: Array) -> Array:
        """Joint torques (joints, ...) [N m] without friction; the first axis of q, dq and ddq runs over the joints."""
        count, shape = len(q), q.shape[1:]
        turn, place = np.broadcast_to(np.eye(3), (*shape, 3, 3)), np.zeros((*shape, 3))
        spin, spun = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        moved = np.broadcast_to(-gravity, (*shape, 3))
        axes, places, forces, moments = [], [], [], []
        for i in range(count):
            step = turn @ self.geometry.translation[i]
            moved = moved + np.cross(spun, step) + np.cross(spin, np.cross(spin, step))
            place = place + step
            turn = turn @ self.geometry.rotation[i]
            axis = turn @ self.geometry.axis[i]
            speed = axis * dq[i][..., None]
            spun = spun + axis * ddq[i][..., None] + np.cross(spin, speed)
            spin = spin + speed
            turn = turn @ _rotations(self.geometry.axis[i], q[i] + self.values.get(f"zero_{i + 1}", 0.0))
            mass, first, inertia = self._link(i + 1)
            moment = turn @ first
            about = turn @ inertia @ np.swapaxes(turn, -1, -2)
            forces.append(mass * moved + np.cross(spun, moment) + np.cross(spin, np.cross(spin, moment)))
            turned = (about @ spin[..., None])[..., 0]
            moments.append(np.cross(moment, moved) + (about @ spun[..., None])[..., 0] + np.cross(spin, turned))
            axes.append(axis)
            places.append(place)
        torque = np.empty_like(q)
        force, total = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        for i in reversed(range(count)):
            if i + 1 < count:
                total = total + np.cross(places[i + 1] - places[i], force)
            force, total = force + forces[i], total + moments[i]
            torque[i] = np.sum(axes[i] * total, axis=-1) + self.values.get(f"armature_{i + 1}", 0.0) * ddq[i]
        return torque

    def _link(self, number: int) -> tuple[float, Array, Array]:
        """Mass [kg], first moment (3,) [kg m] and inertia about the frame's origin (3, 3) [kg m^2]."""
        values = self.values
        first = np.array([values.get(f"moment_{each}_{number}", 0.0) for each in "xyz"])
        inertia = np.zeros((3, 3))
        for name, row, column in _INERTIA:
            inertia[row, column] = inertia[column, row] = values.get(f"inertia_{name}_{number}", 0.0)
        return values.get(f"mass_{number}", 0.0), first, inertia


def _rotations(axis: Array, angle: Array) -> Array:
    """Rotations (..., 3, 3) about an axis (3,) by angles (...,)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    turned: Array = np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)
    return turned
