"""What the description of back-EMF by a smaller armature neglects; see `hil.estimator.simulation.back_emf`."""

from collections.abc import Mapping

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.chain_model import BACK_EMF, ChainModel
from hil.estimator.chain.model.dynamics import TERMS, mass_matrix
from hil.estimator.chain.simulation.drive_times import DriveTimes

POSES = 20


def neglected(model: ChainModel, parameters: Mapping[str, float], position: Array) -> Array:
    """Return the covariance of the base parameters due to it (base parameters, base parameters) [SI].

    A joint's armature is uncertain by the second-order term of the lag, relative to the joint's smallest inertia in the
    motion. position: angles of a motion (joints, samples) [rad].
    """
    count, joints = model.base.count, model.joints
    total = np.zeros((count, count))
    if not model.by_voltage:
        return total
    every = model.base.as_all(np.array([parameters[name] for name in model.base.names]))
    poses = position[:, :: max(1, position.shape[1] // POSES)].T
    inertia = np.min([np.diag(mass_matrix(model.base.chain, every, pose)) for pose in poses], axis=0)
    late = DriveTimes.of(parameters, joints).total
    for joint in sorted(each - 1 for each in model.by_voltage):
        lost = parameters[f"{BACK_EMF}_{joint + 1}"] * parameters[f"viscous_{joint + 1}"] * late[joint]
        armature = np.zeros(TERMS * joints)
        armature[TERMS * joint + TERMS - 1] = lost**2 / max(inertia[joint], lost)
        change = model.base.of_all(armature)
        total += np.outer(change, change)
    return total
