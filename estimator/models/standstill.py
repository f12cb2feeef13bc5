"""Detection of a blocked joint from the range of torque that acts on it without moving it.

Dry friction holds a joint at rest while the torque on it stays within a band twice as wide as the static friction.
Where the band lies depends on gravity and offsets, which may be poorly known; its width does not. Therefore the torque
is compared with the largest and the smallest torque since the joint came to rest: at an unchanged angle, gravity and
offset cancel in these differences, and so do their errors. Only changes due to the motion of other joints have to be
modelled.

A torque outside the band accelerates a free joint. The joint counts as blocked once the motion of a free joint would
show in the velocity register. Twice the momentum of that motion is required, because as long as the position of the
band is unknown, only half of the excess is certain to act on the joint. If a joint moves again, it had been held by
friction; a torque range that it has withstood in this way never raises an alarm again.

These functions are part of compiled loops, which pass a joint's equation, `torque - row theta`, once per sample.
"""

from functools import partial
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import inner

WITHIN_RAD = 0.004
"""Largest change in the angle of a joint at rest [rad], including encoder noise and gear play."""

AT_REST = 0.95
"""Value of the filtered standstill indicator above which a joint counts as at rest. When this value is reached, the
filtered deceleration has decayed.
"""

HOLD_S = 0.03
"""Shortest time for which the torque must lie outside the band [s], which gives a gear time to cross its backlash."""

_SINGLES = 9
# Scalars of a joint, before its two equations: angle at which it came to rest, whether an equation is stored, half of
# the range that it withstood before it moved again, torque of the equations with the lowest and highest residual,
# largest range so far beyond the velocity's rounding, excess momentum to either side, and its duration.
_ANGLE, _SEEN, _WITHSTOOD, _LEAST, _MOST, _RANGE, _UP, _DOWN, _LASTS = range(_SINGLES)


def memory(joints: int, count: int) -> Array:
    """Return an empty memory for `joints` joints with `count` parameters."""
    return np.zeros((joints, _SINGLES + 2 * count))


def withstood(rest: Any) -> float:
    """Return half of the widest torque range over which friction held the joint before it moved again [N m]."""
    return float(rest[_WITHSTOOD])


def is_suspect(rest: Any) -> bool:
    """Return whether the torque is, or was until just now, outside the band that friction can balance."""
    return bool(rest[_UP] > 0.0 or rest[_DOWN] > 0.0)


def forget(rest: Any) -> None:
    """Discard the current standstill because the motion since the previous sample is unknown."""
    rest[_SEEN] = rest[_RANGE] = rest[_UP] = rest[_DOWN] = rest[_LASTS] = 0.0


def look(rest: Any, angle: float, stands: float, torque: float, row: Any, theta: Any) -> float:
    """Process a sample; return the largest difference between its residual torque and those since the joint came to
    rest.

    The residual torque is `torque - row theta`. The difference [N m] is measured from the smallest residual so far
    (positive) or the largest (negative), whichever is further away. It is 0 while the joint moves.

    rest: one joint's row of `memory`. stands: filtered indicator of standstill, 0 to 1. torque, row: equation of the
    joint at this sample [N m]. theta: parameters.
    """
    count = row.size
    if rest[_SEEN] > 0.0 and (stands < AT_REST or abs(angle - rest[_ANGLE]) > WITHIN_RAD):
        rest[_WITHSTOOD] = max(rest[_WITHSTOOD], 0.5 * rest[_RANGE])
        _forget(rest)
    if stands < AT_REST:
        return 0.0
    residual, least, most = torque, rest[_LEAST], rest[_MOST]
    for i in range(count):
        residual -= row[i] * theta[i]
        least -= rest[_SINGLES + i] * theta[i]
        most -= rest[_SINGLES + count + i] * theta[i]
    is_first = rest[_SEEN] <= 0.0
    if is_first:
        rest[_ANGLE], rest[_SEEN] = angle, 1.0
        least = most = residual
    if is_first or residual < least:
        rest[_LEAST] = torque
        _keep(rest, _SINGLES, row)
    if is_first or residual > most:
        rest[_MOST] = torque
        _keep(rest, _SINGLES + count, row)
    return float(residual - least if residual - least >= most - residual else residual - most)


def keep(rest: Any, first: int, row: Any) -> None:
    """Store a joint's equation in columns from `first` on.

    The elements are copied in a loop: a slice assignment would take numba 2 s longer to compile.
    """
    for i in range(row.size):
        rest[first + i] = row[i]


def variance(rest: Any, distance: float, row: Any, covariance: Any) -> float:
    """Return the variance of the result of `look` that is due to the parameters' covariance [N^2 m^2]."""
    count = row.size
    other = rest[_SINGLES : _SINGLES + count] if distance > 0.0 else rest[_SINGLES + count :]
    total = 0.0
    for i in range(count):
        own = row[i] - other[i]
        if own != 0.0:
            for n in range(count):
                total += own * covariance[i, n] * (row[n] - other[n])
    return max(total, 0.0)


def blocked(
    rest: Any,
    distance: float,
    held: float,
    friction: float,
    tolerance: float,
    momentum: float,
    filter_s: float,
    dt: float,
) -> bool:
    """Return whether something other than friction holds the joint.

    distance: result of `look` [N m]. held: torque that certainly acts on the joint now, in one direction. friction:
    largest torque in one direction that dry friction may balance [N m]. tolerance: tolerance of the distance [N m].
    momentum: momentum of the joint at the smallest visible velocity [N m s]. filter_s: time constant of the equation's
    filter [s]. dt: time since the previous sample [s].
    """
    width = abs(distance)
    rest[_RANGE] = max(rest[_RANGE], max(width, 2.0 * held) - momentum / filter_s)
    beyond = width - 2.0 * friction - tolerance
    up, down = (beyond, -width) if distance > 0.0 else (-width, beyond)
    rest[_UP] = max(rest[_UP] + up * dt, 0.0)
    rest[_DOWN] = max(rest[_DOWN] + down * dt, 0.0)
    rest[_LASTS] = rest[_LASTS] + dt if beyond > 0.0 else 0.0
    return bool(max(rest[_UP], rest[_DOWN]) > 2.0 * momentum and rest[_LASTS] >= HOLD_S)


_inner = partial(inner, _nrt=False)  # none of these functions allocates memory
forget = _forget = _inner(forget)
keep = _keep = _inner(keep)
withstood, is_suspect, look, variance, blocked = map(_inner, (withstood, is_suspect, look, variance, blocked))
