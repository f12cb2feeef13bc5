"""Delays of the torque of a chain's drives: the lag of each joint, and the back-EMF of voltage-driven joints.

The back-EMF passes through the same lag as the voltage, so that a joint moves like one whose rotor is lighter by the
product of back-EMF and lag; see `hil.estimator.simulation.back_emf`. The fraction `back_emf` of viscous friction is due
to back-EMF. The lag of a winding cancels at most half of a joint's inertia; it cancels half if the poles of the
equivalent motor coincide. Far from a fit's minimum, the computed loss may be greater; it is then limited to that half.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS, mass_matrix

MEANINGS = {"lag_ratio": "ratio of the lag of the joint's current loop to that of joint 1"}
"""Descriptions of the kinds of parameters that only chains have."""
PART = 0.1
"""A joint's back-EMF is named by `limited` if it causes more than this fraction of the largest inertia loss in any
motion.
"""
MOST_LOST = 0.5
"""Largest fraction of a joint's inertia that a lagging back-EMF may cancel."""
_ARMATURE = 10  # index among a link's parameters
_POSES = np.random.default_rng(4).uniform(-np.pi, np.pi, (6, 7))  # poses in which inertias are compared (poses, joints)


def lags_of(parameters: Mapping[str, float], joints: int) -> Array:
    """Return the lag of each joint's torque (joints,) [s]; 0 if the drives have none."""
    ratios = [parameters.get(f"lag_ratio_{joint + 1}", 1.0) for joint in range(joints)]
    return parameters.get("lag", 0.0) * np.array(ratios)


def lag_slopes(parameters: Mapping[str, float], joints: int) -> Array:
    """Return the derivatives of each joint's lag with respect to joint 1's lag and the joint's ratio (2, joints)."""
    lag = parameters.get("lag", 0.0)
    return np.array([[parameters.get(f"lag_ratio_{j + 1}", 1.0), lag] for j in range(joints)]).T.copy()


def as_moving(base: BaseParameters, parameters: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of the equivalent arm: lighter rotors and a back-EMF that does not lag."""
    moving = dict(parameters)
    for joint, lost in lost_inertia(base, parameters).items():
        for name, factor in zip(base.names, rotor(base, joint), strict=True):
            moving[name] -= lost * factor
    return moving


def lost_inertia(base: BaseParameters, parameters: Mapping[str, float]) -> dict[int, float]:
    """Return the apparent loss of inertia of each voltage-driven joint [kg m^2], by joint (from 0)."""
    generating = _generating(base.chain.joints, parameters)
    possible = _possible(base, parameters, generating)
    return {joint: possible * share * viscous * late for joint, share, viscous, late in generating}


def limited(base: BaseParameters, parameters: Mapping[str, float], std: Array) -> tuple[str, ...]:
    """Return the names of the lagging back-EMFs that would cancel more inertia than the simulation allows.

    This limit biases the estimated inertias. A back-EMF is named only if the inertia that it would cancel exceeds the
    standard error of a base parameter.

    std: standard errors of the base parameters, optionally followed by those of other parameters.
    """
    generating = _generating(base.chain.joints, parameters)
    most, parts = _most_lost(base, parameters, generating)
    if most <= MOST_LOST:
        return ()
    return tuple(
        f"back_emf_{joint + 1}"
        for joint, share, viscous, late in generating
        if parts[joint] > PART and np.any(np.abs(share * viscous * late * rotor(base, joint)) > std[: base.count])
    )


def rotor(base: BaseParameters, joint: int) -> Array:
    """Return what a rotor inertia of 1 kg m^2 at `joint` (from 0) adds to the base parameters (base parameters,)."""
    column: Array = base.grouping[:, TERMS * joint + _ARMATURE]
    return column


Losses = list[tuple[Array, dict[int, float]]]
"""For each voltage-driven joint: what its rotor adds to the base parameters (base parameters,), and the decrease in its
inertia [kg m^2] per unit of each parameter that its lagging back-EMF depends on, keyed by that parameter's index.
"""


def losses(base: BaseParameters, parameters: Mapping[str, float], names: tuple[str, ...]) -> Losses:
    """Return the derivatives of lost inertias with respect to the parameters that cause the loss; see `complete`.

    names: the parameters with respect to which to differentiate; the base parameters come first.
    """
    joints, at = base.chain.joints, {name: index for index, name in enumerate(names)}
    generating = _generating(joints, parameters)
    if _possible(base, parameters, generating) < 1.0:  # at the limit, the loss does not depend on these parameters
        return []
    by_lag, by_ratio = lag_slopes(parameters, joints)
    found = []
    for joint, share, viscous, late in generating:
        changes = {
            f"viscous_{joint + 1}": share * late,
            f"back_emf_{joint + 1}": viscous * late,
            "lag": share * viscous * float(by_lag[joint]),
            f"lag_ratio_{joint + 1}": share * viscous * float(by_ratio[joint]),
            "delay": share * viscous if parameters.get("delay", 0.0) > 0.0 else 0.0,
        }
        found.append((rotor(base, joint), {at[name]: change for name, change in changes.items() if name in at}))
    return found


def complete(lost: Losses, derivative: Array) -> None:
    """Convert derivatives of positions (samples, joints, parameters) in place: from those with respect to the
    parameters of the equivalent arm (`as_moving`) to those of the actual arm. lost: the result of `losses`.
    """
    for rotor_, changes in lost:
        by_rotor = derivative[:, :, : rotor_.size] @ rotor_
        for index, change in changes.items():
            derivative[:, :, index] -= change * by_rotor


def _generating(joints: int, parameters: Mapping[str, float]) -> list[tuple[int, float, float, float]]:
    """For each voltage-driven joint, return its index, the fraction of its viscous friction that is due to back-EMF,
    its viscous friction, and its delay.
    """
    late = lags_of(parameters, joints) + max(parameters.get("delay", 0.0), 0.0)
    return [
        (joint, parameters[f"back_emf_{joint + 1}"], parameters[f"viscous_{joint + 1}"], float(late[joint]))
        for joint in range(joints)
        if f"back_emf_{joint + 1}" in parameters
    ]


def _possible(
    base: BaseParameters, parameters: Mapping[str, float], generating: Sequence[tuple[int, float, float, float]]
) -> float:
    """Return the factor, at most 1, that keeps the inertia lost by a lagging back-EMF within the physical limit."""
    most, _ = _most_lost(base, parameters, generating)
    return min(1.0, MOST_LOST / most) if most > 0.0 else 1.0


def _most_lost(
    base: BaseParameters, parameters: Mapping[str, float], generating: Sequence[tuple[int, float, float, float]]
) -> tuple[float, Array]:
    """Return the largest fraction of inertia lost in any motion, and each joint's contribution to it (joints,)."""
    lost = np.zeros(base.chain.joints)
    for joint, share, viscous, late in generating:
        lost[joint] = share * viscous * late
    if not lost.any() or not np.all(np.isfinite(lost)):
        return 0.0, lost
    every = base.as_all(np.array([parameters[name] for name in base.names]))
    root = np.sqrt(lost)
    largest, parts = 0.0, np.zeros_like(lost)
    for pose in _POSES[:, : base.chain.joints]:
        mass = mass_matrix(base.chain, every, pose)
        if np.all(np.isfinite(mass)) and linalg.eigvalsh(mass)[0] > 0.0:  # other arms cannot be simulated anyway
            fractions, motions = linalg.eigh(root[:, None] * linalg.inv(mass) * root)
            if fractions[-1] > largest:
                largest, parts = float(fractions[-1]), np.square(motions[:, -1])
    return largest, parts
