"""What delays the torque of a chain's drives: each joint's own lag, and the back-EMF of voltage-driven joints.

The back-EMF passes the same lag as the voltage, so that a joint moves like one whose rotor is lighter by the product of
its back-EMF and its lag; see `hil.estimator.simulation.back_emf`. The fraction `back_emf` of viscous friction is due to
it.
"""

from collections.abc import Mapping

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS

MEANINGS = {"lag_ratio": "lag of the joint's current loop relative to joint 1's, as a ratio"}
"""Meanings of the kinds of parameters that only chains have."""
_ARMATURE = 10  # of a link's parameters


def lags_of(parameters: Mapping[str, float], joints: int) -> Array:
    """Return the lag of each joint's torque (joints,) [s]; 0 if the drives have none."""
    ratios = [parameters.get(f"lag_ratio_{joint + 1}", 1.0) for joint in range(joints)]
    return parameters.get("lag", 0.0) * np.array(ratios)


def as_moving(base: BaseParameters, parameters: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of the equivalent arm, with lighter rotors, whose back-EMF does not lag."""
    moving = dict(parameters)
    for joint, share, viscous, late in _generating(base.chain.joints, parameters):
        for name, factor in zip(base.names, _rotor(base, joint), strict=True):
            moving[name] -= share * viscous * late * factor
    return moving


def complete(base: BaseParameters, parameters: Mapping[str, float], names: tuple[str, ...], derivative: Array) -> None:
    """Convert the simulation's derivatives (samples, joints, causes) to those with respect to `names`, in place.

    The simulated arm is that of `as_moving`, and its derivatives are with respect to each joint's own lag. names: the
    base parameters come first.
    """
    at = {name: index for index, name in enumerate(names)}
    ratios = [parameters.get(f"lag_ratio_{joint + 1}", 1.0) for joint in range(base.chain.joints)]
    for joint, share, viscous, late in _generating(base.chain.joints, parameters):
        by_rotor = derivative[:, :, : base.count] @ _rotor(base, joint)
        own = f"lag_ratio_{joint + 1}"
        for name, change in {
            f"viscous_{joint + 1}": share * late,
            f"back_emf_{joint + 1}": viscous * late,
            own if own in at else "lag": share * viscous,
            "delay": share * viscous if parameters.get("delay", 0.0) > 0.0 else 0.0,
        }.items():
            if name in at:
                derivative[:, :, at[name]] -= change * by_rotor
    for joint, ratio in enumerate(ratios):
        if (index := at.get(f"lag_ratio_{joint + 1}")) is not None:
            derivative[:, :, at["lag"]] += ratio * derivative[:, :, index]
            derivative[:, :, index] *= parameters["lag"]


def _generating(joints: int, parameters: Mapping[str, float]) -> list[tuple[int, float, float, float]]:
    """Return each voltage-driven joint, the fraction of its viscous friction due to back-EMF, that friction, and its
    delay.
    """
    late = lags_of(parameters, joints) + max(parameters.get("delay", 0.0), 0.0)
    return [
        (joint, parameters[f"back_emf_{joint + 1}"], parameters[f"viscous_{joint + 1}"], float(late[joint]))
        for joint in range(joints)
        if f"back_emf_{joint + 1}" in parameters
    ]


def _rotor(base: BaseParameters, joint: int) -> Array:
    """Base parameters of a unit rotor inertia of a joint (base parameters,)."""
    column: Array = base.grouping[:, TERMS * joint + _ARMATURE]
    return column
