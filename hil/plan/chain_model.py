"""Assumed model of a spatial arm before and between runs: the arm's description, and the torque of a motion."""

from dataclasses import dataclass

import numpy as np

from hil.config.chain import base_gravity, described_arm
from hil.config.schema import Config
from hil.estimator.arrays import Array
from hil.estimator.chain.excitation.fourier_path import Path
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior
from hil.plan.drive_prior import armatures

MOST_ARMATURE = 0.01
"""Largest armature that the feed-forward assumes for a joint [kg m^2]. If the assumed armature is too small, the
stabiliser supplies the missing torque; if it is too large, a light joint is thrown.
"""

ROUGH_FRICTION = 0.02  # of a joint's largest torque, assumed by the feed-forward
SLOW = 0.1  # rad/s: width of the transition of the assumed dry friction around zero velocity


@dataclass(frozen=True)
class KnownChain:
    """Prior knowledge of a spatial arm from its configuration, before anything is identified."""

    base: BaseParameters
    prior: Prior
    described: Array
    """All parameters of the description (11 * joints,) [SI]."""


@dataclass(frozen=True)
class ChainTorque:
    """Inverse dynamics of an assumed model. rigid: base parameters. friction, offset: (joints,) [SI]."""

    base: BaseParameters
    rigid: Array
    viscous: Array
    coulomb: Array
    offset: Array

    def of(self, path: Path) -> Array:
        """Torque that a path requires (joints, samples) [N m], with dry friction smoothed near standstill."""
        torque = self.base.regressor(path.position, path.velocity, path.acceleration) @ self.rigid
        friction = self.viscous[:, None] * path.velocity + self.coulomb[:, None] * np.tanh(path.velocity / SLOW)
        return np.asarray(torque + friction + self.offset[:, None])


def known_chain(config: Config) -> KnownChain:
    """Read the configuration's description. Raises ArmFileError."""
    arm = described_arm(config)
    base = BaseParameters.of(Chain(*arm.geometry, base_gravity(config)), tilts=config.model.base_tilt)
    rotors = np.minimum(MOST_ARMATURE, armatures(config))
    unsure = torque_constant_stds(config)
    prior = Prior.of(base, arm.parameters, scale_std=unsure if unsure.any() else None)
    return KnownChain(base, prior, np.column_stack((arm.parameters, rotors)).reshape(-1))


def torque_constant_stds(config: Config) -> Array:
    """Relative standard deviation of each joint's torque constant (joints,); all 0 if the configuration gives none.

    If the configuration gives only some of them, the typical value is used for the other joints.
    """
    given = any(joint.torque_per_goal_std for joint in config.joints)
    return np.array([joint.torque_spread if given else 0.0 for joint in config.joints])


def described_torque(config: Config, known: KnownChain) -> ChainTorque:
    """The described arm's inverse dynamics, with a rough guess of friction."""
    rough = ROUGH_FRICTION * torque_limits(config)
    return ChainTorque(known.base, known.base.of_all(known.described), rough, rough, np.zeros_like(rough))


def limit_names(config: Config) -> str:
    """Name the settings that limit the joints' torque: current_limit, voltage_limit in PWM mode, or both."""
    return " or ".join(sorted({joint.goal_limit_name for joint in config.joints}))


def torque_limits(config: Config) -> Array:
    """Largest torque of each joint (joints,) [N m]."""
    return np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
