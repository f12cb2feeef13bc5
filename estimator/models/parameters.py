"""The full set of physical constants one simulation needs, whatever the model leaves out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array

RIGID = ("inertia_1", "coupling", "inertia_2", "armature_2", "gravity_1", "gravity_2")
# Of each joint; the angle's zero is an error of the encoder's: true angle = measured angle + zero.
PER_JOINT = (
    *("viscous", "coulomb", "offset", "coulomb_width", "stribeck_rise", "stribeck_velocity", "load"),
    *("viscous_asymmetry", "ripple_sin", "ripple_cos", "ripple_cycles", "zero", "torque_scale"),
    *("presliding_stiffness", "presliding_damping"),
)
# The order in which the compiled simulation takes them.
CONSTANTS = (*RIGID, *(f"{name}_{joint}" for name in PER_JOINT for joint in (1, 2)))
# What stands for a term the model lacks; a pendulum's second joint is a wheel that nothing turns.
ONE_WHERE_ABSENT = ("armature", "coulomb_width", "stribeck_velocity", "torque_scale")
SLIDING = 0.05  # rad/s: faster than this a joint slides, and its friction's bristles are bent that way
ABSENT = {name: 1.0 if name.rstrip("_12") in ONE_WHERE_ABSENT else 0.0 for name in CONSTANTS}


@dataclass(frozen=True)
class Physics:
    """Constants of one simulation."""

    vector: Array
    """In the order of CONSTANTS (36,) [SI]."""
    delay: float
    """Pure delay of the torque [s]."""
    lag: float
    """Time constant of the torque's first-order lag [s]; 0 for none."""

    @classmethod
    def of(cls, parameters: Mapping[str, float]) -> "Physics":
        """From parameters by name; what is not named is absent from the model.

        Friction with presliding has no step over the velocity: what asks for its width gets SLIDING.
        """
        parameters = dict(parameters)
        parameters |= {
            f"coulomb_width_{joint}": SLIDING for joint in (1, 2) if parameters.get(f"presliding_stiffness_{joint}")
        }
        vector = np.array([parameters.get(name, ABSENT[name]) for name in CONSTANTS])
        return cls(vector, parameters.get("delay", 0.0), parameters.get("lag", 0.0))

    def crossing_time(self) -> float:
        """The shortest time in which friction turned round moves a joint, over its step or on its bristles [s]."""
        constant = dict(zip(CONSTANTS, self.vector.tolist(), strict=True))
        shared = constant["inertia_2"] ** 2 / (constant["inertia_2"] + constant["armature_2"])
        inertia = (
            constant["inertia_1"] + constant["inertia_2"] - shared,
            constant["inertia_2"] + constant["armature_2"],
        )
        times = []
        for joint in (1, 2):
            stiffness = constant[f"presliding_stiffness_{joint}"]
            if stiffness > 0.0:
                # Bristles turned round swing like a spring; an eighth of a radian of that is followed well.
                times.append(0.125 * math.sqrt(inertia[joint - 1] / stiffness))
            else:
                turned = 2.0 * constant[f"coulomb_{joint}"] * (1.0 + constant[f"stribeck_rise_{joint}"])
                times.append(constant[f"coulomb_width_{joint}"] * inertia[joint - 1] / (turned + 1e-12))
        return float(min(times))
