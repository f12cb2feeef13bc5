"""Comparison of the mean torque over the last few tenths of a second with the model stored before that time.

If someone pushes or grips the arm while the model is still being learnt, the model adapts to the disturbance, and the
residual remains small. A model stored before the disturbance is unaffected. Therefore the models stored 5, 10 and 20
updates ago, that is, 0.1, 0.2 and 0.4 s ago, are used: the prediction of each of these models is compared with the mean
torque since it was stored. Averaging cancels effects that change sign during the motion (noise, backlash, ripple), but
not a push. If the joint has hardly moved in that time, the static friction that may have held it is subtracted.

The terms of a joint's equation, `torque - row theta`, are summed over time, so that the mean between any two stored
moments requires one subtraction. These functions are part of compiled loops.
"""

from functools import partial
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import inner

BACK = (5, 10, 20)
"""Numbers of model updates over which the mean is taken."""

TIMES = 3.5
"""Number of standard deviations beyond which a mean residual torque counts as unexplained by the earlier model."""

RELATIVE_STD = 0.1
"""Relative standard deviation of each term of the mean (inertia, gravity, friction). A model that fits one motion is
not exact in the next: in a fast swing, terms several times as large as the commanded torque cancel each other.
"""

IN_A_ROW = 2
"""An unexplained mean residual torque is reported after this number of successive model updates."""

ELASTIC_RAD = 0.03
"""Distance after a reversal over which dry friction approaches its sliding value [rad]. The deviation from that value
can at first be as large as static friction; it falls exponentially with the distance covered.
"""

_SLOTS = max(BACK)
# A moment: sums over time (seconds; per joint torque, indicator of standstill, speed, row), then per joint the variance
# of the noise and the static friction, then the parameters and their covariance. The last row but one of the memory
# holds the present moment; the last one, the number of those stored, the next row to write, and per joint the
# successive model updates with an unexplained mean residual and, once there are enough, that residual.
_SECONDS = 0
_TORQUE, _STANDS, _WAY, _ROW = range(4)
_STORED, _NEXT, _LASTS, _FOUND = 0, 1, 2, 4


def memory(count: int) -> Array:
    """Return an empty memory for two joints with `count` parameters each."""
    return np.zeros((_SLOTS + 2, 1 + 2 * (_ROW + count) + 4 + count + count * count))


def forget(past: Any) -> None:
    """Discard the stored moments because the motion since the previous sample is unknown."""
    past[_SLOTS + 1] = 0.0


def add(past: Any, j: int, torque: float, stands: float, velocity: float, row: Any, dt: float) -> None:
    """Add a sample of joint `j`, `dt` [s] after the previous one.

    torque, row: equation of the joint, filtered [N m]. stands: filtered indicator of standstill. velocity: velocity
    [rad/s].
    """
    now, at = past[_SLOTS], 1 + j * (_ROW + row.size)
    if j == 0:
        now[_SECONDS] += dt
    now[at + _TORQUE] += dt * torque
    now[at + _STANDS] += dt * stands
    now[at + _WAY] += dt * abs(velocity)
    for i in range(row.size):
        now[at + _ROW + i] += dt * row[i]


def describe(past: Any, j: int, count: int, noise: float, friction: float) -> None:
    """Set joint `j`'s noise variance and static friction [N m], to be stored with the next moment."""
    at = 1 + 2 * (_ROW + count)
    past[_SLOTS, at + j], past[_SLOTS, at + 2 + j] = noise, friction


def store(past: Any, theta: Any, covariance: Any) -> None:
    """Store the current moment (the sums so far) with the parameters `theta` and their `covariance`."""
    count, head = theta.size, past[_SLOTS + 1]
    row = past[int(head[_NEXT])]
    at = 1 + 2 * (_ROW + count) + 4
    for i in range(at):  # element by element: assigning a slice takes 2 s to compile
        row[i] = past[_SLOTS, i]
    for i in range(count):
        row[at + i] = theta[i]
        for k in range(count):
            row[at + (1 + i) * count + k] = covariance[i, k]
    head[_NEXT] = (head[_NEXT] + 1.0) % _SLOTS
    head[_STORED] = min(head[_STORED] + 1.0, float(_SLOTS))


def compare(past: Any, j: int, back: int, count: int, floor: float, rounding: float, filter_s: float) -> float:
    """Return joint `j`'s mean residual torque since the model was stored `back` updates ago [N m]; 0 if that model
    explains it.

    count: number of parameters. floor: smallest mean that counts [N m]. rounding: variance of one sample's residual due
    to rounded velocities. filter_s: time constant of the equation's filter [s].
    """
    now, head = past[_SLOTS], past[_SLOTS + 1]
    if head[_STORED] < back:
        return 0.0
    then = past[int(head[_NEXT] - back) % _SLOTS]
    seconds = now[_SECONDS] - then[_SECONDS]
    at, model = 1 + j * (_ROW + count), 1 + 2 * (_ROW + count)
    parameters, covariance = model + 4, model + 4 + count
    mean = (now[at + _TORQUE] - then[at + _TORQUE]) / seconds
    for i in range(count):
        mean -= (now[at + _ROW + i] - then[at + _ROW + i]) / seconds * then[parameters + i]
    stands = (now[at + _STANDS] - then[at + _STANDS]) / seconds
    held = max(stands, np.exp((then[at + _WAY] - now[at + _WAY]) / ELASTIC_RAD))
    beyond = abs(mean) - held * then[model + 2 + j]
    if beyond <= floor:
        return 0.0
    # Only the filtered momenta at both ends enter the mean of a derivative: rounding errors in between cancel.
    variance = then[model + j] + 2.0 * rounding * (filter_s / seconds) ** 2
    for i in range(count):
        own = (now[at + _ROW + i] - then[at + _ROW + i]) / seconds
        if own != 0.0:
            variance += (RELATIVE_STD * own * then[parameters + i]) ** 2
            for n in range(count):
                other = (now[at + _ROW + n] - then[at + _ROW + n]) / seconds
                variance += own * then[covariance + i * count + n] * other
    return float(mean) if beyond > TIMES * np.sqrt(max(variance, 0.0)) else 0.0


def keep(past: Any, j: int, mean: float) -> None:
    """Process the result of joint `j`'s comparisons: a mean residual torque, or 0 if the earlier models explain the
    torque.
    """
    head = past[_SLOTS + 1]
    head[_LASTS + j] = head[_LASTS + j] + 1.0 if mean != 0.0 else 0.0
    head[_FOUND + j] = mean if head[_LASTS + j] >= IN_A_ROW else 0.0


def unexplained(past: Any, j: int) -> float:
    """Return joint `j`'s mean residual torque [N m] if it has stayed unexplained for long enough, otherwise 0."""
    return float(past[_SLOTS + 1, _FOUND + j])


_inner = partial(inner, _nrt=False)  # none of these functions allocates memory
forget, add, describe, store, compare = map(_inner, (forget, add, describe, store, compare))
keep, unexplained = map(_inner, (keep, unexplained))
