"""Nonlinear least squares with some unknowns shared by all segments and others specific to each segment.

A segment's own unknowns only affect its own residuals, so the normal equations have an arrowhead structure: each
segment's block is eliminated separately (Schur complement).
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.errors import ConvergenceError
from hil.estimator.options import SegmentedMinimiserOptions
from hil.estimator.threads import thread_count

Residual = Callable[[int, Array, Array], Array]
"""Returns the residuals (rows,) of one segment for the shared coordinates (shared,) and the segment's own (own,)."""

Derivative = Callable[[int, Array, Array], tuple[Array, Array]]
"""Returns the residuals of one segment as `Residual` does, and their derivatives with respect to the shared and then
the segment's own coordinates (rows, shared + own).
"""

_Step = tuple[Array, Array]
"""A step in the shared coordinates (shared,) and in the segments' own (segments, own), or the coordinates after a step.
"""

DEFAULTS = SegmentedMinimiserOptions()
MIN_SEGMENTS = 3
CURVATURE_STEP = 0.1  # fraction of a step over which the curvature of the residuals is measured
MOST_ACCELERATION = 0.75  # length of the acceleration relative to that of the step
MIN_EIGENVALUE = 1e-12  # relative to the largest; directions with smaller ones have no effect on the residual
MIN_PART = 1e-4  # squared component of a coordinate in such a direction; anything smaller is rounding error


@dataclass(frozen=True)
class Expected:
    """Prior on the shared coordinates: independent normal distributions."""

    centre: Array
    """Means (shared,)."""
    precision: Array
    """Inverse variances times `weight` (shared,), 0 without a prior."""
    weight: float = 1.0
    """Mean square of the residual in units of the noise."""

    @classmethod
    def nothing(cls, size: int) -> "Expected":
        """Return a prior that constrains none of `size` coordinates."""
        return cls(np.zeros(size), np.zeros(size))

    def cost(self, x: Array) -> float:
        """Return the prior's contribution to the sum of squares at the coordinates `x` (shared,)."""
        return float(np.sum(self.precision * (x - self.centre) ** 2))


@dataclass(frozen=True)
class Segmented:
    """Minimum of the sum of squares."""

    shared: Array
    """Shared coordinates (shared,)."""
    own: Array
    """The segments' own coordinates (segments, own)."""
    cost: float
    """Sum of squares."""
    information: Array
    """Information about the shared coordinates, with the segments' own eliminated (shared, shared)."""
    scores: Array
    """Gradient of each segment with respect to the shared coordinates, with its own eliminated (segments, shared)."""
    iterations: int
    variance: float
    """Sum of squares per degree of freedom."""
    expected: Expected | None = None
    """The prior that `information` includes; None without a prior."""

    def covariance(self, groups: npt.NDArray[np.int64] | None = None, own: int = 0) -> Array:
        """Return the sandwich covariance of the shared coordinates (shared, shared), treating segments as independent.

        It remains valid if residuals within a segment are correlated, as model errors are (Liang and Zeger,
        "Longitudinal data analysis using generalized linear models", Biometrika 73 (1986) 13). With fewer segments than
        MIN_SEGMENTS times the number of coordinates, correlations cannot be estimated; the covariance for white noise,
        times a single factor, is then returned. The covariance is infinite for coordinates that can change, alone or
        together, without affecting the residual.

        Every variance is at least as large as for white residuals.

        groups: recording of each segment (segments,). If the recordings differ more than their segments suggest,
        because a repeated motion repeats the model error, the whole covariance is increased accordingly.
        own: number of trailing coordinates, each of which belongs to one recording.
        """
        segments, size = self.scores.shape
        norm = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        bread, hidden = _inverse(self.information / np.outer(norm, norm))
        bread /= np.outer(norm, norm)
        few = segments / max(1, segments - 1)
        if segments < MIN_SEGMENTS * size:
            covariance = few * _size(self.scores, bread) / size * bread
        else:
            meat = few * self.scores.T @ self.scores
            if self.expected is not None:
                meat += self.expected.weight * np.diag(self.expected.precision)
            covariance = bread @ meat @ bread
        wider = np.maximum(np.sqrt(self.variance * np.diag(bread) / np.maximum(np.diag(covariance), 1e-300)), 1.0)
        covariance *= np.outer(wider, wider)
        if groups is not None and np.unique(groups).size > 1:
            together = np.stack([self.scores[groups == group].sum(axis=0) for group in np.unique(groups)])
            fewer = len(together) / (len(together) - 1)
            ratio = fewer * _size(together, bread) / (size - own) / (few * _size(self.scores, bread) / size)
            covariance = max(1.0, ratio) * covariance
        covariance[hidden, hidden] = np.inf
        return np.asarray(covariance)


def _size(scores: Array, bread: Array) -> float:
    """Return the sum of squares of scores (scores, shared) relative to that expected for white noise."""
    return float(np.einsum("si,ij,sj->", scores, bread, scores))


def _inverse(matrix: Array) -> tuple[Array, Array]:
    """Return the pseudo-inverse of a positive semidefinite matrix, and which coordinates it leaves undetermined.

    Directions without effect on the residual are omitted; a coordinate with a component in any of them is undetermined.
    """
    size, direction = linalg.eigh(matrix)
    seen = size > MIN_EIGENVALUE * size[-1]
    inverse: Array = (direction[:, seen] / size[seen]) @ direction[:, seen].T
    part = np.sum(direction[:, ~seen] ** 2, axis=1)
    return inverse, part > MIN_PART


@dataclass(frozen=True)
class _Damping:
    """Damping of the next step."""

    factor: float
    options: SegmentedMinimiserOptions

    @property
    def max_step(self) -> float:
        """Maximum change in a coordinate."""
        return self.options.max_step

    def limited(self, step: _Step) -> _Step:
        """Return the step with every change limited to `max_step`."""
        return np.clip(step[0], -self.max_step, self.max_step), np.clip(step[1], -self.max_step, self.max_step)

    def lower(self) -> "_Damping":
        """Return the damping after a successful step."""
        return replace(self, factor=max(0.2 * self.factor, self.options.min_damping))

    def higher(self) -> "_Damping":
        """Return the damping after a failed step."""
        return replace(self, factor=8.0 * self.factor)


@dataclass(frozen=True)
class _Equations:
    """Normal equations at one point, with one block per segment."""

    residual: list[Array]
    """r: residuals of each segment (rows,)."""
    derivative: list[Array]
    """J: their derivatives with respect to the shared and the segment's own coordinates (rows, shared + own)."""
    shared: Array
    """J'J of the shared coordinates (segments, shared, shared)."""
    mixed: Array
    """J'J between shared and own coordinates (segments, shared, own)."""
    own: Array
    """J'J of the own coordinates (segments, own, own)."""
    prior: Expected
    pull: Array
    """Gradient of the prior (shared,)."""

    @property
    def size(self) -> Array:
        """Squared sensitivity of residuals and prior to the shared coordinates (shared,)."""
        return np.asarray(np.diag(self.shared.sum(axis=0)) + self.prior.precision)

    def eliminated(self, rows: Sequence[Array], damping: float) -> tuple[Array, Array, Array, Array]:
        """Return information and scores for residuals `rows`, with the segments' own coordinates eliminated, and two
        terms for recovering these.
        """
        gradient = np.stack([J.T @ r for J, r in zip(self.derivative, rows, strict=True)])
        shared_gradient, own_gradient = np.split(gradient, [self.shared.shape[1]], axis=1)
        eye = np.eye(self.own.shape[1])
        scale = np.diagonal(self.own, axis1=1, axis2=2).max(axis=1)[:, None, None] * 1e-14
        damped = self.own + damping * self.own * eye + scale * eye
        solve = linalg.solve(damped, np.swapaxes(self.mixed, 1, 2))
        known = linalg.solve(damped, own_gradient[:, :, None])[:, :, 0]
        information = self.shared.sum(axis=0) - np.einsum("sij,sjk->ik", self.mixed, solve)
        scores = shared_gradient - np.einsum("sij,sj->si", self.mixed, known)
        return information + np.diag(self.prior.precision), scores, solve, known

    def solved(self, rows: Sequence[Array], pull: Array, damping: _Damping) -> _Step:
        """Return the damped Gauss-Newton step that reduces `rows`. pull: gradient of the prior (shared,)."""
        information, scores, solve, known = self.eliminated(rows, damping.factor)
        scale = np.sqrt(np.maximum(self.size, 1e-12 * self.size.max()))
        matrix = information / np.outer(scale, scale) + damping.factor * np.eye(pull.size)
        step = -linalg.lstsq(matrix, (scores.sum(axis=0) + pull) / scale, rcond=1e-13)[0] / scale
        step = np.clip(step, -damping.max_step, damping.max_step)
        return damping.limited((step, -known - np.einsum("sij,j->si", solve, step)))

    def length(self, step: _Step) -> float:
        """Return the length of a step, weighted by the sensitivity of the residuals."""
        weights = self.size, np.diagonal(self.own, axis1=1, axis2=2)
        return float(np.sqrt(sum(np.sum(weight * part**2) for weight, part in zip(weights, step, strict=True))))


def minimise_segmented(
    residual: Residual,
    derivative: Derivative,
    shared: Array,
    own: Array,
    ftol: float,
    options: SegmentedMinimiserOptions = DEFAULTS,
    expected: Expected | None = None,
    move: Callable[[Array, Array], Array] = np.add,
) -> Segmented:
    """Minimise the sum of |residual|^2 over all segments by Levenberg-Marquardt with geodesic acceleration.

    `residual` and `derivative` are called from several threads; the number of threads does not affect the result.

    Args:
        residual: returns the residuals of a segment.
        derivative: returns the residuals of a segment and their derivatives.
        shared: initial shared coordinates (shared,), of order 1.
        own: initial coordinates of each segment (segments, own), of order 1.
        ftol: stop when the relative decrease in a step is below this; if damping had to be raised, only after two such
            steps in a row.
        options: limits of the iteration.
        expected: prior on the shared coordinates.
        move: applies a step to the shared coordinates.

    Raises:
        ConvergenceError: if the simulation diverges, or if the relative decrease still exceeds `options.unfinished`
            after `options.max_iterations`.
    """
    prior = expected or Expected.nothing(shared.size)
    with ThreadPoolExecutor(thread_count()) as threads:
        rows = _residuals(residual, shared, own, threads)
        cost = _cost(rows) + prior.cost(shared)
        if not np.isfinite(cost):
            raise ConvergenceError(
                "the simulation diverges at the initial guess: too little motion was recorded, or torque or time "
                "is in the wrong unit"
            )

        def after(shared: Array, own: Array, step: _Step) -> tuple[Array, Array, list[Array]]:
            there = move(shared, step[0]), own + step[1]
            return (*there, _residuals(residual, *there, threads))

        damping, is_curved, was_small = _Damping(options.initial_damping, options), False, False
        for iteration in range(1, options.max_iterations + 1):
            equations = _equations(derivative, prior, shared, own, threads)
            gained, is_first = 0.0, True
            while damping.factor < options.max_damping:
                step = _step(equations, damping, partial(after, shared, own), is_curved)
                *there, rows_there = after(shared, own, step)
                gained = cost - _cost(rows_there) - prior.cost(there[0])
                if gained > 0.0:
                    (shared, own), rows, cost, damping = there, rows_there, cost - gained, damping.lower()
                    break
                damping, is_first, is_curved = damping.higher(), False, True
            is_curved = not is_first
            last, is_small = iteration == options.max_iterations, gained < ftol * cost
            if (is_small and (is_first or was_small)) or (last and gained < options.unfinished * cost):
                return _minimum(_equations(derivative, prior, shared, own, threads), shared, own, cost, iteration)
            was_small = is_small
    raise ConvergenceError(
        f"after {options.max_iterations} iterations the sum of squares, {cost:.4g}, still falls by {gained:.2g} per "
        "iteration: try a simpler friction model or shorter segments"
    )


def _minimum(equations: _Equations, shared: Array, own: Array, cost: float, iterations: int) -> Segmented:
    information, scores, _, _ = equations.eliminated(equations.residual, 0.0)
    rows = equations.residual
    freedom = sum(map(np.count_nonzero, rows)) - shared.size - own.size  # zeros mark missing samples
    variance = _cost(rows) / max(freedom, 1)
    return Segmented(shared, own, cost, information, scores, iterations, variance, equations.prior)


def _cost(rows: Sequence[Array]) -> float:
    with np.errstate(over="ignore"):  # the cost of a diverging motion is infinite
        return float(sum(np.sum(np.square(row)) for row in rows))


def _residuals(residual: Residual, shared: Array, own: Array, threads: ThreadPoolExecutor) -> list[Array]:
    return list(threads.map(lambda s: residual(s, shared, own[s]), range(len(own))))


def _equations(
    derivative: Derivative, prior: Expected, shared: Array, own: Array, threads: ThreadPoolExecutor
) -> _Equations:
    def block(segment: int) -> tuple[Array, Array, Array]:
        r, J = derivative(segment, shared, own[segment])
        with np.errstate(over="ignore", invalid="ignore"):
            return r, J, J.T @ J

    residuals, derivatives, products = zip(*threads.map(block, range(len(own))), strict=True)
    normal = np.stack(products)
    if not (np.isfinite(normal).all() and all(np.isfinite(each).all() for each in residuals)):
        raise ConvergenceError("a simulated motion diverges: check the units, signs and directions of torque and angle")
    n = shared.size
    blocks = normal[:, :n, :n], normal[:, :n, n:], normal[:, n:, n:]
    return _Equations(list(residuals), list(derivatives), *blocks, prior, prior.precision * (shared - prior.centre))


def _step(
    equations: _Equations,
    damping: _Damping,
    after: Callable[[_Step], tuple[Array, Array, list[Array]]],
    is_curved: bool,
) -> _Step:
    """Return a damped step; if `is_curved`, with geodesic acceleration (Transtrum and Sethna, 2012, arXiv:1201.5885).

    The acceleration makes the step follow curved valleys of the sum of squares, such as that of the encoder zeros of a
    small motion. It is used only if it is small compared with the step. after: returns the coordinates and the
    residuals after a step.
    """
    step = equations.solved(equations.residual, equations.pull, damping)
    if not is_curved:
        return step
    part = CURVATURE_STEP
    with np.errstate(over="ignore", invalid="ignore"):
        curvature = [
            2.0 / part * ((there - here) / part - J @ np.concatenate((step[0], its_own)))
            for there, here, J, its_own in zip(
                after((part * step[0], part * step[1]))[2],
                equations.residual,
                equations.derivative,
                step[1],
                strict=True,
            )
        ]
    if not all(np.isfinite(each).all() for each in curvature):
        return step
    bend = equations.solved(curvature, np.zeros_like(equations.pull), damping)
    if equations.length(bend) >= MOST_ACCELERATION * equations.length(step):
        return step
    return damping.limited((step[0] + 0.5 * bend[0], step[1] + 0.5 * bend[1]))
