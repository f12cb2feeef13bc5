"""Largest stiffness and damping that can hold a joint at a given sample rate without oscillation."""

from hil.estimator.arrays import Array
from hil.plan.stabiliser import DELAY_SAMPLES

MOST_DAMPING = 0.3
"""Largest fraction of a joint's velocity that the damper may remove per sample, with the other joints free. At 1 or
more, a single joint would oscillate.
"""

MOST_DRIVING = 0.3
"""Largest fraction of a joint's damping that the delay of its spring may cancel."""


def most_damping(rate: float, lightest: Array) -> Array:
    """Largest damping of each joint [N m s/rad] at a sample rate [Hz]. lightest: smallest inertia (joints,)
    [kg m^2].
    """
    return MOST_DAMPING * rate * lightest


def most_stiffness(rate: float, damping: Array, friction: Array) -> Array:
    """Largest stiffness of each joint [N m/rad] at a sample rate [Hz]. damping: gain of the damper (joints,)
    [N m s/rad]. friction: viscous friction of the joint itself (joints,) [N m s/rad].
    """
    return MOST_DRIVING * rate / DELAY_SAMPLES * (damping + friction)
