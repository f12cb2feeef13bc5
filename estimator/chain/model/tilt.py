"""Tilt of the base: gravity in the base's frame as a function of two small angles.

The tilt is a rotation of the base about a horizontal axis, given by the components of its rotation vector along two
axes that are fixed to the base and perpendicular to the nominal gravity; for an upright base, these are its x and y
axes. Gravity cannot reveal more than two angles.
"""

import numpy as np

from hil.estimator.arrays import Array

TILT = ("base_tilt_x", "base_tilt_y")
"""Names of the two tilt angles [rad]."""

MEANINGS = {name: f"tilt of the base: rotation about its {name[-1]} axis" for name in TILT}

GENERIC = 0.5, -0.4  # rad: angles at which gravity is not aligned with any axis
_STEP = 1e-6  # rad; step of the differences


def tilt_axes(gravity: Array) -> Array:
    """Return the axes of the two angles (2, 3): the base's x and y, after the shortest rotation from -z to gravity."""
    down = gravity / np.linalg.norm(gravity)
    x, y, z = down
    if z > 1.0 - 1e-9:  # hanging from a ceiling: half a turn about x
        return np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    # Rows of the rotation that takes (0, 0, -1) to `down`.
    part = 1.0 / (1.0 - z)
    return np.array([[1.0 - x * x * part, -x * y * part, x], [-x * y * part, 1.0 - y * y * part, y]])


def tilted(gravity: Array, x: float, y: float) -> Array:
    """Transform `gravity` from the frame of the nominal base to the frame of a base tilted by these angles."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0 or (x == 0.0 and y == 0.0):
        return np.array(gravity)
    first, second = tilt_axes(gravity)
    turn = x * first + y * second
    angle = float(np.hypot(x, y))
    turned: Array = np.cos(angle) * gravity - np.sin(angle) / angle * np.cross(turn, gravity)
    return turned


def tilt_slopes(gravity: Array, x: float, y: float) -> Array:
    """Return the derivatives of `tilted` with respect to both angles (2, 3) [m/s^2 per rad]."""
    by_x = tilted(gravity, x + _STEP, y) - tilted(gravity, x - _STEP, y)
    by_y = tilted(gravity, x, y + _STEP) - tilted(gravity, x, y - _STEP)
    return np.stack((by_x, by_y)) / (2.0 * _STEP)


def tilt_between(gravity: Array, real: Array) -> tuple[float, float]:
    """Return the angles for which `tilted(gravity, x, y) == real`, for two vectors of the same length."""
    turn = np.cross(real, gravity)
    sine, cosine = float(np.linalg.norm(turn)), float(real @ gravity)
    if sine == 0.0:
        return 0.0, 0.0
    x, y = tilt_axes(gravity) @ turn * (np.arctan2(sine, cosine) / sine)
    return float(x), float(y)
