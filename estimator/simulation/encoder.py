"""Periodic encoder errors, once and twice per turn, and their derivatives."""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import ENCODER, Physics
from hil.estimator.models.terms import joint_of, kind_of


def measured(physics: Physics, position: Array) -> Array:
    """Return the encoder readings for joints at `position`; both arrays are (joints, samples) [rad]."""
    if not physics.encoder.any():
        return position
    joints = position.shape[0]
    read: Array = position + np.einsum("jc,jsc->js", physics.encoder[:joints], _waves(position))
    return read


def without_errors(physics: Physics, reading: Array) -> Array:
    """Return the joint angles at which the encoders read `reading`; both arrays are (joints, samples) [rad]."""
    if not physics.encoder.any():
        return reading
    encoder = physics.encoder[: reading.shape[0]]
    position = reading
    for _ in range(3):  # errors are some thousandths of a radian, so that three corrections are exact to 1e-8
        position = reading - np.einsum("jc,jsc->js", encoder, _waves(position))
    return position


def slopes_without_errors(physics: Physics, position: Array) -> Array:
    """Return the derivatives of `without_errors` with respect to the joint's encoder errors (joints, samples, errors).

    position: the resulting angles (joints, samples) [rad].
    """
    slopes: Array = -_waves(position) / _steepness(physics, position)[:, :, None]
    return slopes


def by_motion(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parameters in `names` that affect the motion if no spring pulls the arm to encoder readings."""
    return tuple(name for name in names if kind_of(name) not in ENCODER)


def measured_and_slopes(
    physics: Physics, names: tuple[str, ...], moving: tuple[str, ...], position: Array, derivative: Array
) -> tuple[Array, Array]:
    """Return the encoder readings (joints, samples) [rad] and their derivatives.

    The derivatives are with respect to `names`, then the initial state.

    moving: the parameters among `names` on which the motion depends. position: true angles (joints, samples) [rad].
    derivative: derivatives of the true angles with respect to `moving`, then the initial state (joints, samples,
    causes).
    """
    wanted = [name for name in names if kind_of(name) in ENCODER]
    if not wanted and not physics.encoder.any():
        return position, derivative
    waves = _waves(position)
    places = [names.index(name) for name in moving]
    rest = derivative.shape[2] - len(moving)
    full = np.zeros((*derivative.shape[:2], len(names) + rest))
    full[:, :, [*places, *range(len(names), len(names) + rest)]] = (
        derivative * _steepness(physics, position)[:, :, None]
    )
    for name in wanted:
        joint = (joint_of(name) or 1) - 1
        full[joint, :, names.index(name)] += waves[joint, :, ENCODER.index(kind_of(name))]
    return measured(physics, position), full


def _steepness(physics: Physics, position: Array) -> Array:
    """Return the derivative of the readings with respect to the true angles (joints, samples)."""
    sin_1, cos_1, sin_2, cos_2 = np.moveaxis(_waves(position), 2, 0)
    slopes = np.stack((cos_1, -sin_1, 2.0 * cos_2, -2.0 * sin_2), axis=2)
    steepness: Array = 1.0 + np.einsum("jc,jsc->js", physics.encoder[: position.shape[0]], slopes)
    return steepness


def _waves(position: Array) -> Array:
    """Return the sines and cosines that the amplitudes in ENCODER multiply (joints, samples, terms)."""
    return np.stack((np.sin(position), np.cos(position), np.sin(2.0 * position), np.cos(2.0 * position)), axis=2)
