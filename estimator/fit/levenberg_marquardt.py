"""Nonlinear least squares by Levenberg-Marquardt on normal equations, so that the full Jacobian is never stored."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.bounded_step import bounded_step
from hil.estimator.options import MinimiserOptions

DEFAULTS = MinimiserOptions()


@dataclass(frozen=True)
class Quadratic:
    """A sum of squares |r|^2 at one point, with its normal equations."""

    cost: float
    """The sum of squares."""
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
    """The sum of squares at the minimum."""
    iterations: int
    """Number of points at which the sum of squares was evaluated."""
    stalled: bool = False
    """Whether the minimum was accepted because no damping achieved the decrease that the normal equations predict."""


Evaluate = Callable[[Array], Quadratic]
Cost = Callable[[Array], float]
Move = Callable[[Array, Array], Array]
Limits = Callable[[Array], tuple[Array, Array]]


@np.errstate(over="ignore", invalid="ignore")  # for motions that diverge, whose sum is not finite
def minimise(
    evaluate: Evaluate,
    start: Array,
    ftol: float,
    damping: float | None = None,
    at: Quadratic | None = None,
    *,
    cost: Cost | None = None,
    move: Move = np.add,
    limits: Limits | None = None,
    options: MinimiserOptions = DEFAULTS,
) -> Minimum:
    """Minimise a sum of squares from `start`, in coordinates of order 1.

    If the sum alone is much cheaper to compute than its normal equations, pass `cost`: normal equations are then not
    computed for rejected steps, and a step that succeeds is compared with less damped ones.

    Near the minimum, `damping` should start at `options.min_damping`: damped steps are so short along weakly determined
    directions that the iteration would end too early.

    Args:
        evaluate: returns the sum of squares at a point; a non-finite sum counts as too large.
        start: initial coordinates (coordinates,).
        ftol: stop when the actual or predicted relative decrease in one step is below this.
        damping: initial damping; by default `options.initial_damping`.
        at: the sum of squares at `start`, if known.
        cost: returns the sum of squares alone, the same as `evaluate` except for rounding; by default `evaluate` is
            used.
        move: applies a step to coordinates.
        limits: returns the minimum and maximum change of each coordinate in a step; by default +-`options.max_step`.
        options: limits of the iteration.

    Returns:
        The minimum and the number of points evaluated.

    Raises:
        ConvergenceError: if the sum at `start` is not finite, or if its relative decrease still exceeds
            `options.unfinished` after `options.max_iterations`.
    """
    x, here = start, evaluate(start) if at is None else at
    if not np.isfinite(here.cost):
        raise ConvergenceError(
            "the simulation diverges at the initial guess: too little motion was recorded, or torque or time "
            "is in the wrong unit"
        )
    damping = options.initial_damping if damping is None else damping
    evaluations = int(at is None)
    gained = np.inf
    for _ in range(options.max_iterations):
        bounds = step_limits(x, options) if limits is None else limits(x)
        trials = _Trials(x, here, ftol, move, bounds, evaluate, cost)
        found, damping = trials.improve(damping, options)
        evaluations += trials.evaluations
        if found is None:
            return Minimum(x, here, evaluations, stalled=damping >= options.max_damping)
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
    """Return the default minimum and maximum change of each coordinate of `x` in one step."""
    return np.full(x.size, -options.max_step), np.full(x.size, options.max_step)


@dataclass
class _Trials:
    """Damped steps from one point; `evaluations` counts the computations of normal equations."""

    x: Array
    at: Quadratic
    ftol: float
    move: Move
    limits: tuple[Array, Array]
    evaluate: Evaluate
    cost: Cost | None
    evaluations: int = 0
    _latest: tuple[Array, Quadratic] | None = None

    def improve(self, damping: float, options: MinimiserOptions) -> tuple[tuple[Array, Quadratic] | None, float]:
        """Return a better point (None if there is none) and the damping for the next step."""
        while damping < options.max_damping:
            moved, foreseen = self._moved(damping)
            if foreseen < self.ftol * self.at.cost:
                break
            gained = self.at.cost - self._cost_at(moved)
            if gained > 0.0:
                trusted = 0.1 if gained > 0.5 * foreseen else 1.0
                taken = damping
                if self.cost is not None and trusted < 1.0:
                    moved, taken = self._bolder(moved, gained, damping, options)
                there = self._evaluated(moved)
                if there.cost < self.at.cost:
                    return (moved, there), max(options.min_damping, taken * trusted)
            # This point is also reached if `cost` indicated a decrease that the normal equations' simulation does not
            # confirm. The damping of the first step is raised, not that of a less damped one, or the search would never
            # end.
            damping = max(10.0 * damping, options.initial_damping)
        return None, damping

    def _bolder(self, moved: Array, gained: float, damping: float, options: MinimiserOptions) -> tuple[Array, float]:
        """Reduce the damping as long as the point improves; return the best point and its damping."""
        while damping > options.min_damping:
            less = max(options.min_damping, 0.1 * damping)
            further, _ = self._moved(less)
            more = self.at.cost - self._cost_at(further)
            if not more > gained:
                break
            moved, gained, damping = further, more, less
        return moved, damping

    def _moved(self, damping: float) -> tuple[Array, float]:
        """Return the end of a damped step, and the decrease in the sum of squares that the normal equations predict."""
        step = _step(self.at.normal, self.at.gradient, damping, *self.limits)
        return self.move(self.x, step), -float(step @ (2.0 * self.at.gradient + self.at.normal @ step))

    def _cost_at(self, x: Array) -> float:
        if self.cost is not None:
            return self.cost(x)
        self._latest = x, self._evaluated(x)
        return self._latest[1].cost

    def _evaluated(self, x: Array) -> Quadratic:
        if self._latest is not None and self._latest[0] is x:
            return self._latest[1]
        self.evaluations += 1
        return self.evaluate(x)


def _step(normal: Array, gradient: Array, damping: float, least: Array, most: Array) -> Array:
    """Return the damped step, with every coordinate's change between `least` and `most`.

    Only the coordinates that reach their limits are held there. If the whole step were scaled instead, a coordinate
    with almost no effect, such as the logarithm of a value near zero, would hold back all others.
    """
    scale = np.sqrt(np.diag(normal))
    scale = np.maximum(scale, 1e-12 * scale.max())
    matrix = normal / np.outer(scale, scale)
    matrix[np.diag_indices_from(matrix)] += damping
    return np.asarray(bounded_step(matrix, gradient / scale, least * scale, most * scale) / scale)
