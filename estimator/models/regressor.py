"""The arm's dynamics in regressor form: torque is linear in the base parameters, tau = Y(q, q', q'') theta.

The arm has two revolute joints in one plane; joint 1 is measured from the horizontal, joint 2 from link 1. With s the
sign of velocity:

    tau1 = (inertia_1 + inertia_2 + 2 coupling cos q2) q1'' + (inertia_2 + coupling cos q2) q2''
           - coupling sin q2 (2 q1' q2' + q2'^2) + gravity_1 cos q1 + gravity_2 cos(q1 + q2)
           + viscous_1 q1' + coulomb_1 s1 + offset_1
    tau2 = (inertia_2 + coupling cos q2) q1'' + (inertia_2 + armature_2) q2''
           + coupling sin q2 q1'^2 + gravity_2 cos(q1 + q2) + viscous_2 q2' + coulomb_2 s2 + offset_2

A one-joint arm has only the terms inertia_1, gravity_1 and the friction of joint 1.
"""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ShapeError
from hil.estimator.models.terms import base_names


def regressor(position: Array, velocity: Array, acceleration: Array, coulomb_width: float | Array = 0.0) -> Array:
    """Return the regressor Y of the base parameters (joints, samples, parameters).

    Args:
        position: angles (joints, samples) [rad].
        velocity: velocities (joints, samples) [rad/s].
        acceleration: accelerations (joints, samples) [rad/s^2].
        coulomb_width: width of the smoothed sign of velocity, tanh(velocity / coulomb_width) [rad/s], one value for
            all joints or one per joint; 0 for the exact sign.

    Raises:
        ShapeError: if the three arrays differ in shape.
        ModelError: if the arm does not have one or two joints.
    """
    if not position.shape == velocity.shape == acceleration.shape:
        raise ShapeError(
            f"position, velocity and acceleration have the shapes {position.shape}, {velocity.shape} and "
            f"{acceleration.shape}; all must be (joints, samples)"
        )
    joints, samples = position.shape
    Y = np.zeros((joints, samples, len(base_names(joints))))
    rigid = _pendulum(position, acceleration) if joints == 1 else _two_link(position, velocity, acceleration)
    Y[:, :, : rigid.shape[2]] = rigid
    signs = _signs(velocity, np.broadcast_to(coulomb_width, (joints,)))
    for joint in range(joints):
        first = rigid.shape[2] + joint
        Y[joint, :, first] = velocity[joint]
        Y[joint, :, first + joints] = signs[joint]
        Y[joint, :, first + 2 * joints] = 1.0
    return Y


def _signs(velocity: Array, width: Array) -> Array:
    soft = np.tanh(velocity / np.where(width > 0.0, width, 1.0)[:, None])
    return np.where(width[:, None] > 0.0, soft, np.sign(velocity))


def _pendulum(position: Array, acceleration: Array) -> Array:
    return np.stack((acceleration, np.cos(position)), axis=2)


def _two_link(position: Array, velocity: Array, acceleration: Array) -> Array:
    q1, q2 = position
    v1, v2 = velocity
    a1, a2 = acceleration
    cos_2, sin_2 = np.cos(q2), np.sin(q2)
    level_1, level_2 = np.cos(q1), np.cos(q1 + q2)
    nothing = np.zeros_like(q1)
    both = a1 + a2
    coupling_1 = cos_2 * (2.0 * a1 + a2) - sin_2 * (2.0 * v1 * v2 + v2**2)
    coupling_2 = cos_2 * a1 + sin_2 * v1**2
    first = np.stack((a1, coupling_1, both, nothing, level_1, level_2), axis=1)
    second = np.stack((nothing, coupling_2, both, a2, nothing, level_2), axis=1)
    return np.stack((first, second))
