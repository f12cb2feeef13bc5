"""Rigid-body dynamics of a serial chain for whole motions, with arrays as input and output."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.chain.model.geometry import LINK_TERMS, Chain
from hil.estimator.chain.model.kernels import accelerate, move, place, regress, room
from hil.estimator.compiled import compiled
from hil.estimator.errors import ShapeError

TERMS = len(LINK_TERMS) + 1
Columns = npt.NDArray[np.int64]


def inverse_dynamics(chain: Chain, parameters: Array, position: Array, velocity: Array, acceleration: Array) -> Array:
    """Return the joint torques (joints, samples) [N m] of a motion, without friction.

    `parameters`: values in the order of `parameter_names` (11 joints,) [SI]; position, velocity and acceleration: the
    motion (joints, samples) [rad, rad/s, rad/s^2]. Raises ShapeError.
    """
    link, armature = split(chain, parameters)
    q, v, a = _motion(chain, position, velocity, acceleration)
    torque = np.empty_like(q)
    _inverse(*chain.arrays, link, armature, q, v, a, room(chain.joints), torque)
    return np.ascontiguousarray(torque.T)


def mass_matrix(chain: Chain, parameters: Array, position: Array) -> Array:
    """Return the mass matrix (joints, joints) [kg m^2] in one pose (joints,) [rad]."""
    link, armature = split(chain, parameters)
    work = room(chain.joints)
    rotation, translation, axis, _ = chain.arrays
    place(rotation, translation, axis, np.ascontiguousarray(position, dtype=np.float64), work[0], work[1])
    move(link, armature, np.zeros(chain.joints), work)
    mass: Array = work[4]
    return mass


def regressor(
    chain: Chain, position: Array, velocity: Array, acceleration: Array, columns: Columns | None = None
) -> Array:
    """Return the regressor Y of the inertial parameters (joints, samples, parameters), so that torque = Y parameters.

    Arguments as in `inverse_dynamics`; `columns`: indices into `parameter_names`, by default all.
    """
    q, v, a = _motion(chain, position, velocity, acceleration)
    chosen = np.arange(TERMS * chain.joints) if columns is None else columns
    Y = np.zeros((q.shape[0], chain.joints, chosen.size + 1))
    _regressors(*chain.arrays, places(chain.joints, chosen), q, v, a, room(chain.joints), Y)
    return np.ascontiguousarray(np.swapaxes(Y[:, :, :-1], 0, 1))


def places(joints: int, chosen: Columns) -> Columns:
    """Return the index of each link parameter among the chosen ones; `chosen.size` if it is not chosen (joints, 11)."""
    column = np.full(TERMS * joints, chosen.size)
    column[chosen] = np.arange(chosen.size)
    return column.reshape(joints, TERMS)


def split(chain: Chain, parameters: Array) -> tuple[Array, Array]:
    """Split a vector of all parameters into links (joints, 10) and armatures (joints,)."""
    if parameters.shape != (TERMS * chain.joints,):
        raise ShapeError(f"parameters have shape {parameters.shape}; it must be ({TERMS * chain.joints},)")
    table = np.asarray(parameters, dtype=np.float64).reshape(chain.joints, TERMS)
    return np.ascontiguousarray(table[:, :-1]), np.ascontiguousarray(table[:, -1])


def _motion(chain: Chain, *motion: Array) -> tuple[Array, ...]:
    """Return the arrays of a motion as contiguous arrays with samples along the first axis."""
    shapes = {each.shape for each in motion}
    if len(shapes) != 1 or motion[0].ndim != 2 or motion[0].shape[0] != chain.joints:
        raise ShapeError(
            f"position, velocity and acceleration have the shapes {', '.join(str(each.shape) for each in motion)}: "
            f"all must be ({chain.joints}, samples)"
        )
    return tuple(np.ascontiguousarray(each.T, dtype=np.float64) for each in motion)


def _inverse_loop(
    rotation: Any,
    translation: Any,
    axis: Any,
    gravity: Any,
    link: Any,
    armature: Any,
    q: Any,
    v: Any,
    a: Any,
    work: Any,
    torque: Any,
) -> None:
    for k in range(q.shape[0]):
        place(rotation, translation, axis, q[k], work[0], work[1])
        move(link, armature, v[k], work)
        accelerate(armature, gravity, v[k], a[k], work)
        for i in range(q.shape[1]):
            torque[k, i] = work[5][i]


def _regressor_loop(
    rotation: Any,
    translation: Any,
    axis: Any,
    gravity: Any,
    column: Any,
    q: Any,
    v: Any,
    a: Any,
    work: Any,
    Y: Any,
) -> None:
    n = q.shape[1]
    link, armature = np.zeros((n, 10)), np.zeros(n)
    for k in range(q.shape[0]):
        place(rotation, translation, axis, q[k], work[0], work[1])
        move(link, armature, v[k], work)
        accelerate(armature, gravity, v[k], a[k], work)
        regress(column, a[k], work, Y[k])


_inverse: Callable[..., None] = compiled(_inverse_loop)
_regressors: Callable[..., None] = compiled(_regressor_loop)
