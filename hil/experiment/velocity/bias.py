"""Bounds on the bias of a servo's velocity reading, inferred from its positions.

A biased velocity, for example from a register that is rounded downwards, makes the position depart from the integral of
the velocity in proportion to the time in motion, as creep does. But a servo's bias is constant. At first, it may be
anything up to plus or minus half a step. Every sample of a run narrows this range, since position and integral cannot
be farther apart than bias times time plus known errors. Creep that begins later cannot widen the range. If no bias in
the range explains the difference to within twice these errors, the position creeps.
"""

from typing import Any

from hil.estimator.compiled import inner

STEP_RAD_S = 0.025
"""Resolution of the velocity register [rad/s]."""

UNSURE_RAD_S = 0.003
"""Largest accepted change of the bias [rad/s]; the bias may depend on the motion, as when a joint sticks and slips."""

NOISE_RAD, NOISE_TIMES = 0.01, 3.0
"""Smallest assumed error [rad], and the assumed error as a multiple of the RMS residual."""

CERTAINLY = 2.0
"""A difference is a fault if it exceeds this multiple of the errors."""

FIELDS = (("least", "f8"), ("most", "f8"))
"""The range of the bias [rad/s]."""


def begin(bias: Any) -> None:
    """Initialise a record with `FIELDS`."""
    bias["least"], bias["most"] = -0.5 * STEP_RAD_S, 0.5 * STEP_RAD_S


def look(bias: Any, apart: float, errors: float, moving: float) -> bool:
    """Process the difference `apart` [rad] after `moving` [s] of motion; return whether the position creeps.

    If no bias in the current range explains the difference, the range shrinks to the nearest value.
    """
    if abs(unexplained(bias, apart, moving)) > CERTAINLY * errors:
        return True
    bias.least = min(max(bias.least, (apart - errors) / moving), bias.most)
    bias.most = max(min(bias.most, (apart + errors) / moving), bias.least)
    return False


def unexplained(bias: Any, apart: float, moving: float) -> float:
    """Return the part of the difference `apart` [rad] that no bias in the range explains after `moving` [s]."""
    low = max(bias.least - UNSURE_RAD_S, -0.5 * STEP_RAD_S) * moving
    high = min(bias.most + UNSURE_RAD_S, 0.5 * STEP_RAD_S) * moving
    return float(apart - min(max(apart, low), high))


unexplained = inner(unexplained)
look = inner(look)
