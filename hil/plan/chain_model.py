"""What is thought of an arm in space before and between runs: its description, and the torque that a motion takes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.chain import described_arm
from hil.config.schema import Config
from hil.description.urdf import rotation_of
from hil.estimator.chain.excitation.fourier_path import Path
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior

Array = NDArray[np.float64]

ARMATURE = 0.01  # kg m^2: what the feed-forward supposes of every rotor
ROUGH_FRICTION = 0.02  # of a joint's largest torque: what the feed-forward supposes
SLOW = 0.1  # rad/s: where the supposed friction turns round


@dataclass(frozen=True)
class KnownChain:
    """What the configuration says of an arm in space before anything is identified."""

    base: BaseParameters
    prior: Prior
    described: Array
    """All parameters of the description (11 joints,) [SI]."""


@dataclass(frozen=True)
class ChainTorque:
    """The torque of a motion, as far as the arm is known. rigid: base parameters; the rest (joints,) [SI]."""

    base: BaseParameters
    rigid: Array
    viscous: Array
    coulomb: Array
    offset: Array

    def of(self, path: Path) -> Array:
        """To be played for a path (joints, samples) [N m], dry friction rounded off near standstill."""
        torque = self.base.regressor(path.position, path.velocity, path.acceleration) @ self.rigid
        friction = self.viscous[:, None] * path.velocity + self.coulomb[:, None] * np.tanh(path.velocity / SLOW)
        return np.asarray(torque + friction + self.offset[:, None])


def known_chain(config: Config) -> KnownChain:
    """From the configuration's description; raises ArmFileError."""
    arm = described_arm(config)
    gravity = rotation_of(*config.arm.base).T @ np.array([0.0, 0.0, -config.arm.gravity])
    base = BaseParameters.of(Chain(*arm.geometry, gravity))
    rotors = np.full(len(arm.joints), ARMATURE)
    return KnownChain(base, Prior.of(base, arm.parameters), np.column_stack((arm.parameters, rotors)).reshape(-1))


def described_torque(config: Config, known: KnownChain) -> ChainTorque:
    """As the description has it, with a rough guess of friction."""
    rough = ROUGH_FRICTION * torque_limits(config)
    return ChainTorque(known.base, known.base.of_all(known.described), rough, rough, np.zeros_like(rough))


def torque_limits(config: Config) -> Array:
    """Largest torque of each joint (joints,) [N m]."""
    return np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
