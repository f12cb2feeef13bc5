"""Weak prior on base parameters and torque constants that the data do not determine.

It is derived from a description of the arm.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS

SPREAD = 1.0  # relative standard deviation of every described parameter: descriptions are rarely accurate
LEAST_OFFSET = 0.02  # m: minimum standard deviation of a centre of mass
LEAST_GYRATION = 0.05  # m: minimum standard deviation of a radius of gyration
LEAST_SCALE = 1e-3  # relative standard deviation of a torque constant that is given as exact
ARMATURE = 0.02  # kg m^2: standard deviation of an unknown reflected rotor inertia


@dataclass(frozen=True)
class Prior:
    """Prior distribution of the base parameters."""

    value: Array
    """Means (base parameters,) [SI]."""
    std: Array
    """Standard deviations (base parameters,) [SI]."""
    scale_precision: Array | None = None
    """Inverse covariance of the logarithms of the torque scales of all joints but the first (joints - 1, joints - 1);
    None if nothing is known about them."""

    def surpassing(self, names: tuple[str, ...], std: Array) -> tuple[str, ...]:
        """Return the base parameters whose standard errors exceed those of the prior.

        std: standard errors of the base parameters, optionally followed by those of other parameters.
        """
        return tuple(
            name for name, each, own in zip(names, std[: self.std.size], self.std, strict=True) if not each <= own
        )

    @classmethod
    def of(
        cls, base: BaseParameters, links: Array, armature: Array | None = None, scale_std: Array | None = None
    ) -> "Prior":
        """Create the prior from described link parameters.

        Args:
            base: the parameter combinations that affect the torque.
            links: described parameters of the links (joints, 10) [SI].
            armature: rotor inertias (joints,) [kg m^2], if known.
            scale_std: relative standard deviations of the joints' torque constants (joints,), if known.
        """
        joints = base.chain.joints
        rotor = np.full(joints, 0.5 * ARMATURE) if armature is None else armature
        every = np.column_stack((links, rotor))
        assert every.shape == (joints, TERMS)
        std = np.sqrt(base.grouping**2 @ spread_of(every).reshape(-1) ** 2)
        every = every.reshape(-1)
        return cls(base.of_all(every), std, None if scale_std is None else scale_precision(scale_std))


def spread_of(described: Array) -> Array:
    """Return the standard deviations of described links and rotor inertias (joints, TERMS) [SI]."""
    links, rotor = described[:, :-1], described[:, -1]
    mass = np.maximum(links[:, 0], 1e-3)[:, None]
    least = mass * np.array([0.0, *(LEAST_OFFSET,) * 3, *(LEAST_GYRATION**2,) * 6])
    return np.column_stack((np.maximum(SPREAD * np.abs(links), least), np.maximum(rotor, ARMATURE)))


def scale_precision(std: Array) -> Array:
    """Return the precision matrix (joints - 1, joints - 1) of the logarithms of the joints' torque scales.

    A torque scale is the ratio of a joint's torque constant to that of the first joint.

    std: relative standard deviations of the torque constants (joints,).
    """
    variance = np.square(np.maximum(std, LEAST_SCALE))
    return np.asarray(linalg.inv(np.diag(variance[1:]) + variance[0]))
