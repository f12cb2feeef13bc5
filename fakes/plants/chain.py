"""A spatial arm as a plant (see `hil.fakes.plants.plant.Plant`); `chain_kernel` computes its motion."""

from collections.abc import Sequence
from math import ceil, inf

import numpy as np

from hil.fakes.plants.arm import Drive, armature
from hil.fakes.plants.chain_arm import ChainArm
from hil.fakes.plants.chain_kernel import ARMATURE, DRIVE, equations, run
from hil.fakes.plants.motor import JAM, LEAST_GRIP, STEP_PER_WIDTH

LONGEST_STEP = 0.3e-3  # s: with more joints, coupling is stronger; compiled code makes short steps affordable


class SpatialChain:
    """A serial arm of up to seven joints, at rest in its initial pose at time 0."""

    def __init__(self, arm: ChainArm) -> None:
        count = len(arm.joints)
        geometry = arm.description.geometry
        bodies = arm.bodies
        self._chain = (
            *(np.ascontiguousarray(each) for each in geometry),
            np.ascontiguousarray(arm.gravity_vector),
            np.array([body.mass for body in bodies]),
            np.stack([body.centre for body in bodies]),
            np.stack([body.inertia for body in bodies]),
        )
        self._drive = np.array([_constants(drive) for drive in arm.drives]).T.copy()
        assert self._drive.shape == (DRIVE, count)
        self._longest = min(
            [LONGEST_STEP, *(STEP_PER_WIDTH * drive.coulomb_width for drive in arm.drives if drive.coulomb_width)]
        )
        self._held = np.zeros((3, count))
        self._state = np.zeros((4, count))
        self._state[0] = arm.start
        n = count
        shapes = (n, 3, 3), (n, 3), (n, 3), (n, 3), (3, 3), (n, n), (n,)
        self._work = tuple(np.zeros(shape) for shape in shapes)
        self._room = (np.zeros((n, n)), *np.zeros((6, n)), np.zeros((4, n)))
        self._time = 0.0

    @property
    def joints(self) -> int:
        return self._state.shape[1]

    @property
    def position(self) -> Sequence[float]:
        return list(map(float, self._state[0]))

    @property
    def velocity(self) -> Sequence[float]:
        return list(map(float, self._state[1]))

    @property
    def current(self) -> Sequence[float]:
        return list(map(float, self._state[3]))

    def jam(self, joint: int, jammed: bool) -> None:
        self._held[0, joint] = JAM if jammed else 0.0

    def hold(self, joint: int, velocity: float | None) -> None:
        # The grip is just stiff enough to move a bare rotor within one step.
        grip = max(2.0 * self._drive[ARMATURE, joint] / self._longest, LEAST_GRIP)
        self._held[1:, joint] = (0.0, 0.0) if velocity is None else (grip, velocity)

    def advance(self, until: float, current: Sequence[float]) -> None:
        remaining = until - self._time
        if remaining <= 0.0:
            return
        self._time = until
        command = np.asarray(current, dtype=np.float64)
        longest = remaining / ceil(remaining / self._longest)
        run(self._chain, self._drive, self._held, self._state, command, remaining, longest, self._work, self._room)

    def equations(self, q: Sequence[float], v: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix in a given state, and the joint torques at which the acceleration is zero.

        The mass matrix (joints, joints) [kg m^2] excludes the rotors; the torques are (joints,) [N m].
        """
        equations(self._chain, np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64), self._work)
        return self._work[5].copy(), self._work[6].copy()


def _constants(drive: Drive) -> tuple[float, ...]:
    """Return the constants of a drive in the order of `chain_kernel`."""
    low, high = drive.stops or (-inf, inf)
    return (
        *(drive.torque_constant, drive.current_lag, drive.offset, drive.viscous),
        *(drive.coulomb, drive.coulomb_width, drive.stribeck_rise, 1.0 / drive.stribeck_velocity),
        *(drive.load, drive.ripple, drive.ripple_cycles),
        *(low, high, drive.stop_stiffness, drive.stop_damping, armature(drive)),
    )
