"""The bias that a servo's velocity reading may have, as far as its positions have shown it.

A register that is rounded downwards, say, is half a step too low on average. The position then moves away from the
integral of the velocity in proportion to the time in motion, as a position that creeps does. A servo's bias is
constant: the range of values that it may have is at first plus or minus half a step, and every moment of a run bounds
it further, since position and integral cannot be farther apart than bias times time plus known errors. A creep that
begins later leaves that range, and cannot widen it. Where twice these errors do not explain the distance, the position
creeps.
"""

from typing import Any

import numba

STEP_RAD_S = 0.025
"""Resolution of the velocity register [rad/s]."""

UNSURE_RAD_S = 0.003
"""Change of the bias that is accepted: it may depend on the motion, for a joint that sticks and slips, say [rad/s]."""

NOISE_RAD, NOISE_TIMES = 0.01, 3.0
"""Smallest error that is assumed [rad], and the assumed error as a multiple of the RMS of what remains unexplained."""

CERTAINLY = 2.0
"""Multiple of the errors from which a difference is a fault."""

FIELDS = (("least", "f8"), ("most", "f8"))
"""The range of the bias [rad/s]."""


def begin(bias: Any) -> None:
    """Initialise a record with `FIELDS`."""
    bias["least"], bias["most"] = -0.5 * STEP_RAD_S, 0.5 * STEP_RAD_S


def look(bias: Any, apart: float, errors: float, moving: float) -> bool:
    """Process the difference after `moving` seconds of motion [rad, s]; return whether the position creeps.

    If no bias in the present range explains it, the range shrinks to the nearest value.
    """
    if abs(unexplained(bias, apart, moving)) > CERTAINLY * errors:
        return True
    bias.least = min(max(bias.least, (apart - errors) / moving), bias.most)
    bias.most = max(min(bias.most, (apart + errors) / moving), bias.least)
    return False


def unexplained(bias: Any, apart: float, moving: float) -> float:
    """Return what no bias in the range explains of a difference `apart` after `moving` seconds of motion [rad, s]."""
    low = max(bias.least - UNSURE_RAD_S, -0.5 * STEP_RAD_S) * moving
    high = min(bias.most + UNSURE_RAD_S, 0.5 * STEP_RAD_S) * moving
    return float(apart - min(max(apart, low), high))


_inner: Any = numba.njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)  # type: ignore[call-overload]
unexplained = _inner(unexplained)
look = _inner(look)
