"""Nonlinear least squares with some unknowns shared by all segments and others specific to each segment.

A segment's own unknowns only affect its own residuals, so the normal equations have an arrowhead structure: each
segment's block is eliminated separately (Schur complement).
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.errors import ConvergenceError
from hil.estimator.options import SegmentedMinimiserOptions
from hil.estimator.threads import thread_count

Residual = Callable[[int, Array, Array], Array]
"""Returns the residuals (rows,) of one segment at the shared coordinates (shared,) and its own (own,)."""

Derivative = Callable[[int, Array, Array], tuple[Array, Array]]
"""Returns the residuals of one segment as `Residual` does, and their derivatives with respect to the shared and then
the segment's own coordinates (rows, shared + own).
"""

DEFAULTS = SegmentedMinimiserOptions()
MIN_SEGMENTS = 3
MIN_EIGENVALUE = 1e-12  # relative to the largest; directions below have no effect on the residual
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
class _Blocks:
    """Normal equations, one block per segment."""

    shared: Array
    """J'J of the shared coordinates (segments, shared, shared)."""
    mixed: Array
    """J'J between shared and own coordinates (segments, shared, own)."""
    own: Array
    """J'J of the own coordinates (segments, own, own)."""
    shared_gradient: Array
    """J'r of the shared coordinates (segments, shared)."""
    own_gradient: Array
    """J'r of the own coordinates (segments, own)."""

    def reduced(self, damping: float) -> tuple[Array, Array, Array, Array]:
        """Return information and scores with the segments' own coordinates eliminated, and two terms for recovering
        these.
        """
        eye = np.eye(self.own.shape[1])
        scale = np.diagonal(self.own, axis1=1, axis2=2).max(axis=1)[:, None, None] * 1e-14
        damped = self.own + damping * self.own * eye + scale * eye
        solve = linalg.solve(damped, np.swapaxes(self.mixed, 1, 2))
        known = linalg.solve(damped, self.own_gradient[:, :, None])[:, :, 0]
        information = self.shared.sum(axis=0) - np.einsum("sij,sjk->ik", self.mixed, solve)
        scores = self.shared_gradient - np.einsum("sij,sj->si", self.mixed, known)
        return information, scores, solve, known


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
    """Minimise the sum of |residual|^2 over all segments by Levenberg-Marquardt.

    `residual` and `derivative` are called from several threads; their number does not affect the result.

    Args:
        residual: returns the residuals of a segment.
        derivative: returns the residuals of a segment and their derivatives.
        shared: initial shared coordinates (shared,), of order 1.
        own: initial coordinates of each segment (segments, own), of order 1.
        ftol: stop when the relative decrease in one step is below this.
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
        damping = options.initial_damping
        for iteration in range(1, options.max_iterations + 1):
            blocks = _blocks(derivative, shared, own, threads)
            gained = 0.0
            while damping < options.max_damping:
                step, own_there = _stepped(blocks, prior, shared, own, damping, options.max_step)
                there = move(shared, step), own_there
                rows_there = _residuals(residual, *there, threads)
                gained = cost - _cost(rows_there) - prior.cost(there[0])
                if gained > 0.0:
                    (shared, own), rows, cost = there, rows_there, cost - gained
                    damping = max(0.2 * damping, options.min_damping)
                    break
                damping = max(8.0 * damping, options.initial_damping)
            last = iteration == options.max_iterations
            if gained < ftol * cost or (last and gained < options.unfinished * cost):
                blocks = _blocks(derivative, shared, own, threads)
                information, scores, _, _ = blocks.reduced(0.0)
                information = information + np.diag(prior.precision)
                freedom = sum(map(np.count_nonzero, rows)) - shared.size - own.size  # zeros mark missing samples
                variance = _cost(rows) / max(freedom, 1)
                return Segmented(shared, own, cost, information, scores, iteration, variance, prior)
    raise ConvergenceError(
        f"after {options.max_iterations} iterations the sum of squares, {cost:.4g}, still falls by {gained:.2g} per "
        "iteration: try a simpler friction model or shorter segments"
    )


def _cost(rows: Sequence[Array]) -> float:
    with np.errstate(over="ignore"):  # the cost of a diverging motion is infinite
        return float(sum(np.sum(np.square(row)) for row in rows))


def _residuals(residual: Residual, shared: Array, own: Array, threads: ThreadPoolExecutor) -> list[Array]:
    return list(threads.map(lambda s: residual(s, shared, own[s]), range(len(own))))


def _blocks(derivative: Derivative, shared: Array, own: Array, threads: ThreadPoolExecutor) -> _Blocks:
    def block(segment: int) -> tuple[Array, Array]:
        r, J = derivative(segment, shared, own[segment])
        with np.errstate(over="ignore", invalid="ignore"):
            return J.T @ J, J.T @ r

    products = list(threads.map(block, range(len(own))))
    normal = np.stack([product[0] for product in products])
    gradient = np.stack([product[1] for product in products])
    if not (np.isfinite(normal).all() and np.isfinite(gradient).all()):
        raise ConvergenceError("a simulated motion diverges: check the units, signs and directions of torque and angle")
    n = shared.size
    return _Blocks(normal[:, :n, :n], normal[:, :n, n:], normal[:, n:, n:], gradient[:, :n], gradient[:, n:])


def _stepped(
    blocks: _Blocks, prior: Expected, shared: Array, own: Array, damping: float, max_step: float
) -> tuple[Array, Array]:
    information, scores, solve, known = blocks.reduced(damping)
    information = information + np.diag(prior.precision)
    gradient = scores.sum(axis=0) + prior.precision * (shared - prior.centre)
    full = np.diag(blocks.shared.sum(axis=0)) + prior.precision
    scale = np.sqrt(np.maximum(full, 1e-12 * full.max()))
    matrix = information / np.outer(scale, scale) + damping * np.eye(shared.size)
    step = -linalg.lstsq(matrix, gradient / scale, rcond=1e-13)[0] / scale
    step = np.clip(step, -max_step, max_step)
    own_step = -known - np.einsum("sij,j->si", solve, step)
    return step, own + np.clip(own_step, -max_step, max_step)
