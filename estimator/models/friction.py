"""Friction of one joint at given velocities, in numpy, for computations with identified parameters.

The law is that of `hil.estimator.simulation.arm`, whose compiled loop also computes its derivatives. `values` are
parameters by name [SI]; missing terms have no effect.
"""

from collections.abc import Mapping

import numpy as np

from hil.estimator.arrays import Array

Values = Mapping[str, float]


def direction(v: Array, width: float) -> Array:
    """Return the direction of motion at the velocities `v`: a step from -1 to 1, smoothed over `width` [rad/s]."""
    return np.asarray(np.tanh(v / width) if width > 0.0 else np.sign(v))


def viscous(values: Values, joint: int, v: Array, step: Array) -> Array:
    """Return the viscous friction of `joint` (from 1) [N m]; step: result of `direction` for this joint."""
    moving = values.get(f"viscous_{joint}", 0.0) * v
    asymmetry = values.get(f"viscous_asymmetry_{joint}", 0.0)
    return np.asarray(moving + asymmetry * v * step if asymmetry else moving)


def dry_level(values: Values, joint: int, v: Array) -> Array:
    """Return the dry friction level of `joint` (from 1) at the velocities `v`, without the part due to load [N m]."""
    level = values.get(f"coulomb_{joint}", 0.0)
    rise = values.get(f"stribeck_rise_{joint}", 0.0)
    if not rise:
        return np.full_like(v, level)
    return np.asarray(level * (1.0 + rise * np.exp(-((v / values[f"stribeck_velocity_{joint}"]) ** 2))))
