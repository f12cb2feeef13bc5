"""Rotor inertia and friction that a joint's servos are expected to have: as configured, or typical of the model."""

from typing import Literal

import numpy as np

from hil.config.schema import Config
from hil.drivers.servo_prior import Guess, servo_prior
from hil.estimator.arrays import Array


def armatures(config: Config) -> Array:
    """Expected armature of each joint (joints,) [kg m^2]."""
    return np.array([guess.median for guess in _guesses(config, "armature")])


def low_armatures(config: Config) -> Array:
    """Armature of each joint (joints,) [kg m^2], one standard deviation less than expected."""
    return np.array([guess.low for guess in _guesses(config, "armature")])


def low_viscous(config: Config) -> Array:
    """Viscous friction of each joint (joints,) [N m s/rad], one standard deviation less than expected."""
    return np.array([guess.low for guess in _guesses(config, "viscous")])


def _guesses(config: Config, name: Literal["armature", "viscous"]) -> list[Guess]:
    given = config.arm.prior
    values = None if given is None else getattr(given, name)
    if given is not None and values is not None:
        return [Guess(value, given.spread) for value in values]
    typical = [(len(joint.ids), getattr(servo_prior(joint.joint.servo), name)) for joint in config.joints]
    return [Guess(servos * guess.median, guess.spread) for servos, guess in typical]
