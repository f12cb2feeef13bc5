"""A weak prior on the base parameters from a description of the arm, for what the data do not determine."""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS

SPREAD = 1.0  # relative standard deviation of every described parameter: descriptions are rarely accurate
LEAST_OFFSET = 0.02  # m: minimum standard deviation of a centre of mass
LEAST_GYRATION = 0.05  # m: minimum standard deviation of a radius of gyration
ARMATURE = 0.02  # kg m^2: standard deviation of an unknown reflected rotor inertia


@dataclass(frozen=True)
class Prior:
    """Prior distribution of the base parameters."""

    value: Array
    """Means (base parameters,) [SI]."""
    std: Array
    """Standard deviations (base parameters,) [SI]."""

    @classmethod
    def of(cls, base: BaseParameters, links: Array, armature: Array | None = None) -> "Prior":
        """Create the prior from described link parameters (joints, 10) and, if known, armatures (joints,)."""
        joints = base.chain.joints
        rotor = np.full(joints, 0.5 * ARMATURE) if armature is None else armature
        every = np.column_stack((links, rotor)).reshape(-1)
        mass = np.maximum(links[:, 0], 1e-3)[:, None]
        least = mass * np.array([0.0, *(LEAST_OFFSET,) * 3, *(LEAST_GYRATION**2,) * 6])
        spread = np.column_stack((np.maximum(SPREAD * np.abs(links), least), np.maximum(rotor, ARMATURE)))
        std = np.sqrt(base.grouping**2 @ spread.reshape(-1) ** 2)
        assert spread.shape == (joints, TERMS)
        return cls(base.of_all(every), std)
