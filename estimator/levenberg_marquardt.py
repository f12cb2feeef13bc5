"""Nonlinear least squares by Levenberg-Marquardt; the columns of its Jacobian are taken in parallel."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array
from estimator.errors import ConvergenceError
from estimator.normal_equations import normal_equations, sum_of_squares

Residual = Callable[[Array], Array]

DIFFERENCE = 1e-4  # of a coordinate, which is of the size of 1
LONGEST = 2.0  # change of one coordinate in one step
ITERATIONS = 60
UNFINISHED = 1e-2
FIRST_DAMPING = 1e-3  # of the squared length of each coordinate's column
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e3


@dataclass(frozen=True)
class Minimum:
    """Where the sum of squares is least."""

    x: Array
    """Coordinates (coordinates,)."""
    normal: Array
    """J'J of the Jacobian J of the residual by x (coordinates, coordinates)."""
    gradient: Array
    """J'r (coordinates,)."""
    cost: float
    """Sum of squares."""
    iterations: int


def minimise(residual: Residual, start: Array, enough: float) -> Minimum:
    """Minimise |residual(x)|^2 from `start`, coordinates of the size of 1.

    Ends when a step lowers the sum of squares, or would, by less than `enough` of it. `residual` is called
    from several threads at once; a sum that is not finite counts as too large. The result does not depend
    on the number of threads. Raises ConvergenceError when `start` gives no finite sum, or when the sum
    still falls by more than UNFINISHED of it after ITERATIONS.
    """
    x, r = start, residual(start)
    cost = sum_of_squares(r)
    if not np.isfinite(cost):
        raise ConvergenceError("the starting values give no finite motion: check the torque and the period's units")
    damping = FIRST_DAMPING
    gained = np.inf
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        for iteration in range(1, ITERATIONS + 1):
            normal, gradient = normal_equations(_jacobian(residual, x, r, threads), r)
            found = Minimum(x, normal, gradient, cost, iteration)
            trial, damping = _improve(residual, found, damping, enough)
            if trial is None:
                return found
            x, r = trial
            gained, cost = cost - sum_of_squares(r), sum_of_squares(r)
            if gained < enough * cost:
                return Minimum(x, normal, gradient, cost, iteration)
    if gained < UNFINISHED * cost:
        return Minimum(x, normal, gradient, cost, ITERATIONS)
    raise ConvergenceError(
        f"after {ITERATIONS} iterations the sum of squares, {cost:.4g}, still falls by {gained:.2g} in each: "
        "try a simpler model or data with more motion"
    )


def _improve(
    residual: Residual, at: Minimum, damping: float, enough: float
) -> tuple[tuple[Array, Array] | None, float]:
    """A better point and its residual, or None when there is none in sight; and the next step's damping."""
    while damping < MOST_DAMPING:
        step = _step(at.normal, at.gradient, damping)
        foreseen = -float(step @ (2.0 * at.gradient + at.normal @ step))
        if foreseen < enough * at.cost:
            break
        there = residual(at.x + step)
        gained = at.cost - sum_of_squares(there)
        if gained > 0.0:
            return (at.x + step, there), max(LEAST_DAMPING, damping * (0.1 if gained > 0.5 * foreseen else 1.0))
        damping = max(10.0 * damping, FIRST_DAMPING)
    return None, damping


def _step(normal: Array, gradient: Array, damping: float) -> Array:
    """The damped step, no coordinate moving by more than LONGEST.

    A coordinate that would is held there and the others solved again: scaling the whole step would let one
    that is all but flat, such as the logarithm of something that is zero, stop the rest.
    """
    scale = np.sqrt(np.diag(normal))
    scale = np.maximum(scale, 1e-12 * scale.max())
    damped = normal + damping * np.diag(scale**2)
    step = np.zeros_like(gradient)
    free = np.ones(gradient.size, dtype=np.bool_)
    while free.any():
        slope = (gradient[free] + damped[np.ix_(free, ~free)] @ step[~free]) / scale[free]
        matrix = damped[np.ix_(free, free)] / np.outer(scale[free], scale[free])
        step[free] = -np.linalg.solve(matrix, slope) / scale[free]
        too_long = free & (np.abs(step) > LONGEST)
        if not too_long.any():
            break
        step[too_long] = np.clip(step[too_long], -LONGEST, LONGEST)
        free &= ~too_long
    return step


def _jacobian(residual: Residual, x: Array, r: Array, threads: ThreadPoolExecutor) -> Array:
    def column(i: int) -> Array:
        moved = x.copy()
        moved[i] += DIFFERENCE
        return (residual(moved) - r) / DIFFERENCE

    return np.stack(list(threads.map(column, range(x.size))), axis=1)
