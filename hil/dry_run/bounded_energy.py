"""Check whether an unpowered arm has too little energy to move beyond its position limits.

An unpowered arm cannot reach a pose with more potential energy than its total energy. If every pose on the boundary of
the permitted range has more potential energy than that, the arm's swing need not be simulated.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import CONSTANTS, Physics

_POINTS = 181
"""Number of angles of the other joint at which the potential energy on the boundary is evaluated."""
_MARGIN = 0.05
"""Margin for grid and integration errors, as a fraction of the largest potential energy."""


@dataclass(frozen=True)
class Boundary:
    """The position limits of an arm and the lowest potential energy at them.

    low, high: limits (joints,) [rad]. least: lowest potential energy at the limits [J]; -inf if the model's parameters
    do not bound the arm's energy.
    """

    physics: Physics
    low: Array
    high: Array
    least: float

    @cached_property
    def _constants(self) -> dict[str, float]:
        return _by_name(self.physics)

    def holds(self, position: Array, velocity: Array) -> bool:
        """Whether an unpowered arm at `position` with `velocity` (joints,) [rad, rad/s] stays within its limits."""
        if not np.isfinite(self.least) or (position <= self.low).any() or (position >= self.high).any():
            return False
        constants = self._constants
        energy = _kinetic(constants, position, velocity) + float(_potential(constants, position[:, None])[0])
        return energy < self.least


def boundary(physics: Physics, low: Array, high: Array) -> Boundary:
    """Return the boundary for limits `low` and `high` (joints,) [rad]."""
    constants = _by_name(physics)
    if not _only_dissipates(constants, low.size):
        return Boundary(physics, low, high, -np.inf)
    faces = [_potential(constants, face) for face in _faces(low, high)]
    everything = np.concatenate(faces)
    return Boundary(physics, low, high, float(everything.min()) - _MARGIN * float(np.abs(everything).max()))


def _by_name(physics: Physics) -> dict[str, float]:
    return dict(zip(CONSTANTS, physics.vector.tolist(), strict=True))


def _only_dissipates(p: dict[str, float], joints: int) -> bool:
    """Whether the drives only dissipate energy; springs and offsets count as potential energy."""
    return all(
        p[f"viscous_{k}"] >= abs(p[f"viscous_asymmetry_{k}"])
        and p[f"coulomb_{k}"] >= 0.0
        and p[f"load_{k}"] >= 0.0
        and p[f"stribeck_rise_{k}"] >= -1.0
        and p[f"presliding_stiffness_{k}"] <= 0.0
        and p[f"saturation_{k}"] == 0.0
        and (p[f"back_emf_{k}"] == 0.0 or p[f"ripple_cycles_{k}"] == 0.0)
        for k in range(1, joints + 1)
    )


def _faces(low: Array, high: Array) -> list[Array]:
    """Poses (joints, points) on each face of the permitted range."""
    if low.size == 1:
        return [low[:, None], high[:, None]]
    faces = []
    for joint, side in product(range(2), (low, high)):
        other = np.linspace(low[1 - joint], high[1 - joint], _POINTS)
        fixed = np.full(_POINTS, side[joint])
        faces.append(np.stack((fixed, other) if joint == 0 else (other, fixed)))
    return faces


def _potential(p: dict[str, float], position: Array) -> Array:
    """Potential energy of gravity, springs and constant torques (points,) [J] at `position` (joints, points) [rad]."""
    first = position[0] + p["zero_1"]
    energy: Array = p["gravity_1"] * np.sin(first)
    if len(position) == 2:
        energy = energy + p["gravity_2"] * np.sin(first + position[1] + p["zero_2"])
    for joint, angle in enumerate(position, start=1):
        energy = energy + p[f"offset_{joint}"] * angle + 0.5 * p[f"cable_stiffness_{joint}"] * angle**2
    return energy


def _kinetic(p: dict[str, float], position: Array, velocity: Array) -> float:
    if velocity.size == 1:
        return 0.5 * p["inertia_1"] * float(velocity[0]) ** 2
    across = p["coupling"] * float(np.cos(position[1] + p["zero_2"]))
    first, second = float(velocity[0]), float(velocity[1])
    return 0.5 * (
        (p["inertia_1"] + p["inertia_2"] + 2.0 * across) * first**2
        + 2.0 * (p["inertia_2"] + across) * first * second
        + (p["inertia_2"] + p["armature_2"]) * second**2
    )
