"""Back-EMF of joints driven by voltage: a part of the motor's torque, and as late as the voltage.

A voltage u drives the current i through the winding, lag i' = (u - k v) / R - i: what the motor generates passes the
same lag as the command. Of viscous friction the share `back_emf` is k^2 / R. A first-order lag of it is, with the motor
written as a voltage that lags and a brake that does not,

    1 / (lag J s^2 + J s + b) = 1 / ((lag' s + 1) ((J - b lag') s + b)),    lag' (J - b lag') = lag J

exactly so for a joint of inertia J and brake b: the same motion as that of a command with the lag lag' on a joint whose
inertia is less by b lag'. That is how it is simulated: `Physics.of` takes back_emf viscous (lag + delay) off the
inertia that only this joint feels. On an XL430 that is 5 to 10 % of it. The lag found is lag', a little more than the
winding's. What friction does to the motor's current comes too late by lag' - lag, about a tenth of a millisecond.

Ripple, saturation and friction under load belong to the motor's torque, so to the voltage's less what is generated
(`hil.estimator.simulation.arm`).
"""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import CONSTANTS, GENERATED, OWN_INERTIA, VISCOUS, Physics

_LATE: dict[str, tuple[int, ...]] = {"lag": (0, 1), "delay": (0, 1), "lag_difference_2": (1,)}
"""Of which joints a parameter makes the torque late."""


def causes_of(physics: Physics, names: tuple[str, ...]) -> tuple[str, ...]:
    """What the simulation must differentiate by for derivatives by `names`."""
    through = [
        CONSTANTS[place]
        for joint in _generating(physics)
        for place in (GENERATED + joint, OWN_INERTIA[joint])
        if CONSTANTS[place] not in names
    ]
    return (*names, *through)


def by_names(physics: Physics, names: tuple[str, ...], derivative: Array) -> Array:
    """Derivatives (joints, samples, causes) by the parameters `names` and the rest, from those of the simulation by
    `causes_of` them and the rest, where viscous friction and back-EMF are two constants and inertia is a third.
    """
    joints = _generating(physics)
    if not joints:
        return derivative
    causes = causes_of(physics, names)
    kept = [*range(len(names)), *range(len(causes), derivative.shape[2])]
    full = derivative[:, :, kept]
    for joint in joints:
        generated, inertia = (
            derivative[:, :, causes.index(CONSTANTS[place])] for place in (GENERATED + joint, OWN_INERTIA[joint])
        )
        viscous, torque = float(physics.vector[VISCOUS + joint]), float(physics.vector[GENERATED + joint])
        by_generated = generated - float(physics.late[joint]) * inertia
        for name, change in {
            f"viscous_{joint + 1}": torque / viscous * by_generated,
            **{name: -torque * inertia for name, late in _LATE.items() if joint in late},
        }.items():
            if name in names:
                full[:, :, names.index(name)] += change
        share = f"back_emf_{joint + 1}"
        if share in names:
            full[:, :, names.index(share)] = viscous * by_generated
    return full


def _generating(physics: Physics) -> list[int]:
    """Joints, from 0, that are driven by voltage."""
    return [int(joint) for joint in np.flatnonzero(physics.vector[GENERATED : GENERATED + 2])]
