"""Primal active-set method for the step that minimises a convex quadratic function within bounds.

Clipping the unconstrained step and solving again for the free coordinates would instead hold some coordinates at bounds
that are inactive at the constrained minimum. In a narrow valley such a step can even lead uphill (Nocedal and Wright,
Numerical Optimization, section 16.5).
"""

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask

ITERATIONS_PER_COORDINATE = 6
TOLERANCE = 1e-9
"""A slope at a bound counts as zero if it is below this fraction of the largest slope."""


def bounded_step(matrix: Array, slope: Array, least: Array, most: Array) -> Array:
    """Return the step s (coordinates,) within `least` and `most` that minimises s'Ms / 2 + g's.

    Every iterate is feasible and no worse than s = 0, so that the result is a descent step even if it is not exact.

    Args:
        matrix: M, positive definite (coordinates, coordinates).
        slope: g (coordinates,).
        least: lower bounds (coordinates,), at most 0.
        most: upper bounds (coordinates,), at least 0; a coordinate whose bounds are both 0 is fixed.
    """
    step = np.asarray(-linalg.solve(matrix, slope), dtype=np.float64)
    if np.all((step >= least) & (step <= most)):
        return step
    movable = least < most
    free = movable.copy()
    step = np.zeros_like(slope)
    for _ in range(ITERATIONS_PER_COORDINATE * slope.size):
        direction = np.zeros_like(slope)
        if free.any():
            held = matrix[np.ix_(free, ~free)] @ step[~free]
            direction[free] = -linalg.solve(matrix[np.ix_(free, free)], slope[free] + held) - step[free]
        share, blocking = _share_until_bound(step, direction, least, most)
        step = np.clip(step + share * direction, least, most)
        if blocking is not None:
            # Set exactly: with a rounding error, the upper bound would be mistaken for the lower one on release.
            step[blocking] = most[blocking] if direction[blocking] > 0.0 else least[blocking]
            free[blocking] = False
            continue
        released = _wrongly_held(slope + matrix @ step, step, most, movable & ~free, TOLERANCE * np.abs(slope).max())
        if released is None:
            break
        free[released] = True
    return step


def _share_until_bound(step: Array, direction: Array, least: Array, most: Array) -> tuple[float, int | None]:
    """Return the fraction of `direction` within the bounds, and the coordinate that limits it, if any."""
    room = np.where(direction > 0.0, most - step, least - step)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(direction != 0.0, room / direction, np.inf)
    first = int(np.argmin(share))
    return (max(0.0, float(share[first])), first) if share[first] < 1.0 else (1.0, None)


def _wrongly_held(slope: Array, step: Array, most: Array, held: Mask, tolerance: float) -> int | None:
    """Return the held coordinate along which the function decreases fastest away from its bound, if there is one."""
    inwards = np.where(step >= most, slope, -slope)
    inwards = np.where(held, inwards, -np.inf)
    best = int(np.argmax(inwards))
    return best if inwards[best] > tolerance else None
