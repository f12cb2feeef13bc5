"""Nonlinear least squares by Levenberg-Marquardt on normal equations, so that the full Jacobian is never stored."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ConvergenceError
from hil.estimator.options import MinimiserOptions

DEFAULTS = MinimiserOptions()


@dataclass(frozen=True)
class Quadratic:
    """A sum of squares |r|^2 at one point and how it changes there."""

    cost: float
    """The sum."""
    normal: Array
    """J'J of the Jacobian J of r (coordinates, coordinates)."""
    gradient: Array
    """J'r (coordinates,)."""


@dataclass(frozen=True)
class Minimum:
    """Minimum of the sum of squares."""

    x: Array
    """Coordinates (coordinates,)."""
    at: Quadratic
    """The sum of squares there."""
    iterations: int
    """Points at which it was evaluated."""


Evaluate = Callable[[Array], Quadratic]
Move = Callable[[Array, Array], Array]
Limits = Callable[[Array], tuple[Array, Array]]


def minimise(
    evaluate: Evaluate,
    start: Array,
    ftol: float,
    damping: float | None = None,
    at: Quadratic | None = None,
    *,
    move: Move = np.add,
    limits: Limits | None = None,
    options: MinimiserOptions = DEFAULTS,
) -> Minimum:
    """Minimise a sum of squares from `start`, coordinates of the size of 1.

    Damped steps are short along weakly determined directions and terminate too early there: near the end, `damping`
    should start at `options.min_damping`.

    Args:
        evaluate: the sum at a point; a non-finite sum counts as too large.
        start: coordinates (coordinates,).
        ftol: stop when the actual or predicted relative decrease of a step is below this.
        damping: initial damping; by default `options.initial_damping`.
        at: the sum at `start`, if it is known.
        move: applies a step to coordinates.
        limits: gives the least and the most that each coordinate may change in a step from a point; by default
            `options.max_step` either way.
        options: limits of the iteration.

    Returns:
        The minimum, and how many points were evaluated.

    Raises:
        ConvergenceError: when `start` gives no finite sum, or when the sum still falls by more than
            `options.unfinished` of it after `options.max_iterations`.
    """
    x, here = start, evaluate(start) if at is None else at
    if not np.isfinite(here.cost):
        raise ConvergenceError("the initial guess gives no finite motion: check the torque and the period's units")
    damping = options.initial_damping if damping is None else damping
    evaluations = int(at is None)
    gained = np.inf
    for _ in range(options.max_iterations):
        bounds = step_limits(x, options) if limits is None else limits(x)
        found, damping, tried = _improve(evaluate, x, here, damping, ftol, move, bounds, options)
        evaluations += tried
        if found is None:
            return Minimum(x, here, evaluations)
        gained = here.cost - found[1].cost
        x, here = found
        if gained < ftol * here.cost:
            return Minimum(x, here, evaluations)
    if gained < options.unfinished * here.cost:
        return Minimum(x, here, evaluations)
    raise ConvergenceError(
        f"after {options.max_iterations} iterations the sum of squares, {here.cost:.4g}, still falls by {gained:.2g} "
        "per iteration: try a simpler model or data with more motion"
    )


def step_limits(x: Array, options: MinimiserOptions) -> tuple[Array, Array]:
    """The least and the most that each coordinate of `x` may change in one step if nothing else limits it."""
    return np.full(x.size, -options.max_step), np.full(x.size, options.max_step)


def _improve(
    evaluate: Evaluate,
    x: Array,
    at: Quadratic,
    damping: float,
    ftol: float,
    move: Move,
    limits: tuple[Array, Array],
    options: MinimiserOptions,
) -> tuple[tuple[Array, Quadratic] | None, float, int]:
    """A better point, or None if there is none; the next step's damping; and the points tried."""
    tried = 0
    while damping < options.max_damping:
        step = _step(at.normal, at.gradient, damping, *limits)
        foreseen = -float(step @ (2.0 * at.gradient + at.normal @ step))
        if foreseen < ftol * at.cost:
            break
        moved = move(x, step)
        there = evaluate(moved)
        tried += 1
        gained = at.cost - there.cost
        if gained > 0.0:
            trusted = 0.1 if gained > 0.5 * foreseen else 1.0
            return (moved, there), max(options.min_damping, damping * trusted), tried
        damping = max(10.0 * damping, options.initial_damping)
    return None, damping, tried


def _step(normal: Array, gradient: Array, damping: float, least: Array, most: Array) -> Array:
    """The damped step, every coordinate moving by no less than `least` and no more than `most`.

    A coordinate that would is held there and the others solved again: scaling the whole step would let one
    that is all but flat, such as the logarithm of something that is zero, stop the rest.
    """
    scale = np.sqrt(np.diag(normal))
    scale = np.maximum(scale, 1e-12 * scale.max())
    matrix = normal / np.outer(scale, scale)
    matrix[np.diag_indices_from(matrix)] += damping
    slope = gradient / scale
    step = np.zeros_like(gradient)
    free = np.ones(gradient.size, dtype=np.bool_)
    while free.any():
        held = np.where(free, 0.0, step * scale)
        step[free] = -np.linalg.solve(matrix[free][:, free], (slope + matrix @ held)[free]) / scale[free]
        too_long = free & ((step < least) | (step > most))
        if not too_long.any():
            break
        step[too_long] = np.clip(step, least, most)[too_long]
        free &= ~too_long
    return step
