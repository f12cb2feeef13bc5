"""The full set of physical constants for one simulation, including those of terms that the model omits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.terms import TERMS, constants, term_of

CONSTANTS = constants()
"""Names of the constants, in the order in which the compiled simulation takes them."""
ABSENT = {name: term_of(name).absent for name in CONSTANTS}
"""Values that disable terms missing from the model; a one-joint arm gets a second joint that moves freely."""
ENCODER = tuple(name for name, term in TERMS.items() if term.part == "encoder")
"""Terms that describe encoder errors that repeat with every turn."""
LEAST_LAG = 1e-6  # s
SLIDING = 0.05  # rad/s: velocity above which a joint slides, with its bristles deflected in the direction of motion


LEAST_INERTIA = 0.2
"""Minimum fraction of a joint's own inertia that remains after the correction for delayed back-EMF."""


def place_of(term: str) -> int:
    """Return the index of a term's constant in `Physics.vector`. If the term has one constant per joint, this is the
    index for joint 1; the index for joint 2 is the next.
    """
    return CONSTANTS.index(term if TERMS[term].scope == "arm" else f"{term}_1")


VISCOUS, GENERATED = place_of("viscous"), place_of("back_emf")
OWN_INERTIA = CONSTANTS.index("inertia_1"), CONSTANTS.index("armature_2")
"""For each joint, the index of the constant that contains the joint's own inertia, including its rotor's."""


@dataclass(frozen=True)
class Physics:
    """Physical constants of one simulation."""

    vector: Array
    """Constants in the order of CONSTANTS (constants,) [SI].

    Here back_emf is not a share of viscous friction but the coefficient itself [N m s/rad].
    """
    delay: float
    """Pure delay of the torque [s]."""
    lag: float
    """Time constant of the torque's first-order lag [s]; 0 for none."""
    encoder: Array = field(default_factory=lambda: np.zeros((2, len(ENCODER))))
    """Encoder errors by joint, in the order of ENCODER (2, terms) [rad]."""
    lag_difference: float = 0.0
    """Lag of joint 2's torque minus lag of joint 1's torque [s]; without a lag, the difference in delay."""

    @classmethod
    def of(cls, parameters: Mapping[str, float]) -> "Physics":
        """Return the constants for parameters given by name; all other terms are disabled.

        With presliding, friction has no Coulomb step; code that needs the step's width uses SLIDING.
        """
        parameters = dict(parameters)
        parameters |= {
            f"coulomb_width_{joint}": SLIDING for joint in (1, 2) if parameters.get(f"presliding_stiffness_{joint}")
        }
        vector = np.array([parameters.get(name, ABSENT[name]) for name in CONSTANTS])
        encoder = np.array([[parameters.get(f"{name}_{joint}", 0.0) for name in ENCODER] for joint in (1, 2)])
        beyond = parameters.get("lag_difference_2", 0.0)
        physics = cls(vector, parameters.get("delay", 0.0), parameters.get("lag", 0.0), encoder, beyond)
        # Back-EMF is given as a share of viscous friction; see `hil.estimator.simulation.back_emf`.
        vector[GENERATED : GENERATED + 2] *= vector[VISCOUS : VISCOUS + 2]
        for joint in np.flatnonzero(vector[GENERATED : GENERATED + 2]):
            place, lacking = OWN_INERTIA[joint], vector[GENERATED + joint] * physics.late[joint]
            vector[place] = max(vector[place] - lacking, LEAST_INERTIA * vector[place])
        return physics

    @property
    def delays(self) -> Array:
        """Pure delay of each joint's torque (2,) [s]."""
        return np.array([self.delay, self.delay + (0.0 if self.lag > 0.0 else self.lag_difference)])

    @property
    def lags(self) -> Array:
        """Time constant of each joint's lag (2,) [s]; that of joint 2 stays above 0 if the drives have a lag."""
        return np.array([self.lag, max(self.lag + self.lag_difference, LEAST_LAG) if self.lag > 0.0 else 0.0])

    @property
    def late(self) -> Array:
        """Total delay of each joint's torque: pure delay plus lag (2,) [s]."""
        late: Array = self.lags + np.maximum(self.delays, 0.0)
        return late

    def crossing_times(self) -> tuple[float, float]:
        """Return the time [s] in which a reversal of friction takes each joint across its Coulomb step, or deflects its
        bristles.
        """
        constant = dict(zip(CONSTANTS, self.vector.tolist(), strict=True))
        inertia = self.free_inertias()
        times = []
        for joint in (1, 2):
            stiffness = constant[f"presliding_stiffness_{joint}"]
            if stiffness > 0.0:
                # Bristles reacting to a reversal oscillate like a spring; an eighth of a radian per substep resolves
                # this well.
                times.append(0.125 * math.sqrt(inertia[joint - 1] / stiffness))
            else:
                turned = 2.0 * constant[f"coulomb_{joint}"] * (1.0 + constant[f"stribeck_rise_{joint}"])
                times.append(constant[f"coulomb_width_{joint}"] * inertia[joint - 1] / (turned + 1e-12))
        return times[0], times[1]

    def free_inertias(self) -> tuple[float, float]:
        """Return the inertia of each joint about its own axis while the other moves freely, with the arm straight [kg
        m^2].
        """
        constant = dict(zip(CONSTANTS, self.vector.tolist(), strict=True))
        outer = constant["inertia_2"] + constant["armature_2"]
        shared = constant["inertia_2"] ** 2 / outer if outer else 0.0
        return constant["inertia_1"] + constant["inertia_2"] - shared, outer
