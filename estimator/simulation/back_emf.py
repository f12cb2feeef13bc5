"""Back-EMF of joints driven by voltage: part of the motor torque, with the same lag as the voltage.

A voltage u drives the current i through the winding, lag i' = (u - k v) / R - i, so the back-EMF passes through the
same lag as the command. It causes the fraction `back_emf` of viscous friction, b = k^2 / R. The equivalent motor, with
a lagging voltage and a brake b without lag, is

    1 / (lag J s^2 + J s + b) = 1 / ((lag' s + 1) ((J - b lag') s + b)),    lag' (J - b lag') = lag J

This is exact for a joint of inertia J, which moves as if its inertia were smaller by b lag'. Therefore `Physics.of`
subtracts back_emf viscous (lag + delay) from the joint's own inertia, which is 5 to 10 % of that inertia on an XL430.
The estimated lag is lag', slightly larger than that of the winding.

If the voltage is delayed by d relative to the back-EMF, because a goal waits for the servo's control loop, the
estimated inertia is too large by b d, whatever the lag.

Ripple, saturation and load-dependent friction act on the motor's torque, which is the torque of the voltage minus the
torque of the back-EMF (`hil.estimator.simulation.arm`).
"""

import math
from collections.abc import Mapping

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import CONSTANTS, GENERATED, LEAST_INERTIA, OWN_INERTIA, VISCOUS, Physics

UNKNOWN_DELAY = 5e-4
"""Standard deviation of the delay d of the voltage, for a control loop of 1 ms [s]."""

_LATE: dict[str, tuple[int, ...]] = {"lag": (0, 1), "delay": (0, 1), "lag_difference_2": (1,)}
"""For each parameter, the joints whose torque it delays."""


def causes_of(physics: Physics, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the constants with respect to which the simulation must differentiate to obtain the derivatives for
    `names`.
    """
    through = [
        CONSTANTS[place]
        for joint in _generating(physics)
        for place in (GENERATED + joint, OWN_INERTIA[joint])
        if CONSTANTS[place] not in names
    ]
    return (*names, *through)


def by_names(physics: Physics, names: tuple[str, ...], derivative: Array) -> Array:
    """Return derivatives (joints, samples, causes) with respect to the parameters `names`, then with respect to all
    other causes.

    derivative: the simulation's derivatives with respect to the constants that `causes_of` returns, then the same other
    causes (the initial state, for example). In the simulation, viscous friction, back-EMF and the joint's inertia are
    separate constants.
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


def neglected_inertia(brake: float, lost: float, inertia: float, delay: float) -> float:
    """Return the standard deviation of a joint's inertia due to effects that this model neglects [kg m^2].

    The effect of friction on the motor's current is delayed by lag' - lag. On most arms this is negligible, but it
    amounts to 5 % of the inertia of an XL430 with hardly any load. The delay d of the voltage contributes 1 to 2 %.

    brake: b [N m s/rad]. lost: b lag' [kg m^2]. delay: pure delay [s]; part or all of it may affect only the voltage.
    """
    return math.hypot(lost**2 / inertia, brake * max(UNKNOWN_DELAY, 0.5 * delay))


def neglected(physics: Physics) -> dict[str, float]:
    """Return `neglected_inertia` of each voltage-driven joint [kg m^2]; keys are the names of the inertias."""
    found = {}
    for joint in _generating(physics):
        place, brake = OWN_INERTIA[joint], float(physics.vector[GENERATED + joint])
        lost = brake * float(physics.late[joint])
        inertia = float(physics.vector[place]) + lost
        found[CONSTANTS[place]] = neglected_inertia(brake, lost, inertia, physics.delay)
    return found


def limited(parameters: Mapping[str, float]) -> tuple[str, ...]:
    """Return the names of the back-EMFs that would cancel more of their joint's inertia than the simulation allows
    (`LEAST_INERTIA`). The simulated reduction is then too small, which biases the estimated inertia.
    """
    physics = Physics.of(parameters)
    found = []
    for joint in _generating(physics):
        lost = float(physics.vector[GENERATED + joint] * physics.late[joint])
        if lost >= (1.0 - LEAST_INERTIA) * parameters[CONSTANTS[OWN_INERTIA[joint]]]:
            found.append(f"back_emf_{joint + 1}")
    return tuple(found)


def _generating(physics: Physics) -> list[int]:
    """Return the joints (from 0) that are driven by voltage."""
    return [int(joint) for joint in np.flatnonzero(physics.vector[GENERATED : GENERATED + 2])]
