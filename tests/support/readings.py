"""Motions of one joint as its readings show them, and when the consistency check detects something in them."""

import math
from collections.abc import Callable

from tests.support.one_joint import Consistency

STEP, TICK = math.tau / 4096, 0.229 * math.tau / 60
"""Resolution of position and velocity [rad, rad/s]."""


def quantised(value: float, step: float) -> float:
    return round(value / step) * step


def seen_after(
    rate: int, position: Callable[[float], float], velocity: Callable[[float], float], start: float = 0.0
) -> float:
    """Time of detection [s]; infinite if nothing is detected within six seconds."""
    look = Consistency()
    for index in range(6 * rate):
        now = start + index / rate
        if look.look(quantised(position(now), STEP), quantised(velocity(now), TICK), 1 / rate):
            return now
    return math.inf


def learnt_motion(now: float) -> tuple[float, float]:
    """Position and velocity of a swinging joint whose servo filters the velocity with a lag of 5 ms."""
    late = now - 0.005
    return (
        0.4 * math.sin(math.tau * now) + 0.2 * math.sin(5.3 * now),
        0.4 * math.tau * math.cos(math.tau * late) + 0.2 * 5.3 * math.cos(5.3 * late),
    )
