"""Inertias of a chain's joints in a recording, and the narrowest smoothed Coulomb steps that a simulation resolves.

The method is that of `hil.estimator.fit.resolved_widths`.
"""

from collections.abc import Mapping

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.model.dynamics import mass_matrix
from hil.estimator.chain.model.late_torque import as_moving

POSES = 40  # number of poses of a recording in which the joints' inertias are computed


def resolved_widths(problem: ChainProblem, x: Array, shortest_step: float, widths_per_substep: float) -> Array:
    """Return the narrowest Coulomb step that is resolved for each joint (joints,) [rad/s].

    Args:
        problem: the recordings.
        x: coordinates at which the arm can be simulated.
        shortest_step: shortest integration step, near standstill [s].
        widths_per_substep: number of widths that a joint may traverse in `shortest_step` when its friction reverses;
            see `hil.estimator.options.CoordinateOptions`.
    """
    model = problem.model
    parameters = as_moving(model.base, problem.parameters(x))
    inertia = free_inertias(problem, parameters)
    reversal = 2.0 * np.array([parameters[f"coulomb_{joint + 1}"] for joint in range(model.joints)]) / inertia
    return np.asarray(reversal * shortest_step / widths_per_substep)


def free_inertias(problem: ChainProblem, parameters: Mapping[str, float]) -> Array:
    """Return each joint's inertia about its own axis while all others move freely (joints,) [kg m^2].

    The result is the minimum over the poses of the recordings.
    """
    model = problem.model
    every = model.base.as_all(np.array([parameters[name] for name in model.base.names]))
    inertia = np.inf * np.ones(model.joints)
    for period in problem.periods:
        for q in period.filled()[:, :: max(1, period.samples // POSES)].T:
            inverse = linalg.pinv(mass_matrix(model.base.chain, every, q), hermitian=True)
            inertia = np.minimum(inertia, 1.0 / np.maximum(np.diag(inverse), 1e-9))
    return inertia
