"""Stage 2 for chains: maximum likelihood of one-step-ahead position predictions, starting from stage 1.

A rough minimum with a soft observer (`hil.estimator.chain.fit.starts`) is refined. Most iterations use coarse
integration steps; the last ones use fine steps. The noise level of each joint is itself estimated before the final
iterations, in which outliers are downweighted (Huber).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import kind_of
from hil.estimator.chain.fit.held_zeros import HeldZeros, held_zeros
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.options import DEFAULTS, ChainOptions
from hil.estimator.chain.fit.remaining import remaining
from hil.estimator.chain.fit.stage1 import ChainLinear
from hil.estimator.chain.fit.starts import first_problem, integration_steps, narrowed, repeated, resolved, started
from hil.estimator.chain.fit.uncertainty import coloured_covariance, neglected_covariance
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.late_torque import limited
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.covariance import (
    by_parameters,
    correlation_time,
    larger_covariance,
    robust_covariance,
    structured_share,
)
from hil.estimator.fit.levenberg_marquardt import Minimum
from hil.estimator.fit.noise_weights import noise_weights
from hil.estimator.models.bounds import MOVED, beyond_range, finite_std, step_beyond
from hil.estimator.options import CovarianceOptions, MinimiserOptions

MINIMISER, COVARIANCE = MinimiserOptions(), CovarianceOptions()
NEARER, LAST = MinimiserOptions(max_damping=0.1), MinimiserOptions(max_damping=1.0)
"""Options for the last iterations with coarse steps, and for the subsequent iterations with fine steps.

If a joint is on the verge of sticking, the sum of squares is slightly discontinuous. A decrease achieved only with
heavy damping is due to such a discontinuity and is not pursued.
"""


@dataclass(frozen=True)
class ChainFit:
    """The most likely parameters under one model."""

    value: Array
    """Values in the order of `ChainModel.names` [SI]."""
    covariance: Array
    """Covariance at the minimum, robust to correlated errors."""
    missing: Array
    """Estimated distance from `value` to the minimum (parameters,) [SI]."""
    white_covariance: Array
    """Covariance of `value` if the errors of all samples were independent."""
    starts: tuple[Array, ...]
    """State at the first sample of each period (2, joints) [rad, rad/s]."""
    positions: tuple[Array, ...]
    """Predicted positions of each period (joints, samples) [rad]."""
    outliers: int
    """Number of samples that were downweighted."""
    correlation_time: float
    """Number of samples over which the residual is correlated; 1 for white noise."""
    iterations: int
    """Number of simulations with derivatives."""
    softness: float
    """Natural frequency of the observer at the end [Hz]."""
    remaining: float
    """Expected decrease in the sum of squares from one more step, which would reach the minimum."""
    neglected: Array
    """Covariance due to effects neglected in the model of voltage-driven joints (parameters, parameters) [SI]."""
    at_bound: tuple[str, ...] = ()
    """Parameters at a bound although the data favour values beyond it; empty unless this affects base parameters."""
    held_zeros: HeldZeros | None = None
    """Result of the test of the encoder zeros that the model holds fixed; None if the model fits them or has one joint,
    or if no test was requested.
    """

    @property
    def total_covariance(self) -> Array:
        """Covariance of the errors of `value`: the covariance at the minimum, widened by the distance to the minimum
        and by the effects that the model is known to neglect.
        """
        return np.asarray(self.covariance + np.outer(self.missing, self.missing) + self.neglected)

    @property
    def reached(self) -> bool:
        """Whether the fit has reached its minimum, that is, whether one more step would be shorter than one standard
        error.
        """
        return self.remaining <= DEFAULTS.unfinished


def fit_periods(
    periods: Sequence[SettledPeriod],
    model: ChainModel,
    linear: ChainLinear,
    prior: Prior,
    options: ChainOptions = DEFAULTS,
    added: Sequence[Array | None] = (),
    near: ChainFit | None = None,
) -> ChainFit:
    """Return the maximum-likelihood parameters of `model`, starting from stage 1's result `linear`.

    added: see `fit_lines`. near: an earlier fit of the same model, from which the fit starts instead, but with Coulomb
    steps no wider than `options.initial_width`. Raises ConvergenceError.
    """
    problem, x = first_problem(periods, model, linear, prior, options)
    problem = replace(problem, added=tuple(added))
    # Undivided steps cannot resolve friction near standstill: a friction shape fitted with such steps would end up far
    # away in a curved valley, along which the later fits progress slowly.
    coarse = replace(problem, steps=integration_steps(periods, options.coarse_step), reach=0.0)
    if near is None:
        sticking, rough, spent = started(coarse, x, options)
    else:
        soft = narrowed(problem, near.value, near.starts, options)
        sticking, rough, spent = resolved(replace(coarse, softness=near.softness), soft, options)
        spent += near.iterations
    bounded = sticking.coordinates
    positions = sticking.positions(rough.x)
    assert positions is not None  # the motion at the minimum is finite
    weights, outliers = noise_weights(periods, positions, options.outlier_threshold)
    weights = tuple((weight * repeated(each)).T for weight, each in zip(weights, periods, strict=True))
    nearer = replace(sticking, weights=weights, reach=options.reach).minimise(
        rough.x, options.ftol_nearer, options=NEARER
    )
    last = replace(sticking, weights=weights, steps=problem.steps, finer=options.finest, reach=options.reach)
    damped = last.minimise(nearer.x, options.ftol, options=LAST)
    # Damping holds back poorly determined coordinates, so it is removed now. Had it been absent from the beginning,
    # many coordinates would have reached their step limits and held up the others.
    minimum = damped
    if not damped.stalled:
        minimum = last.minimise(damped.x, options.ftol, MINIMISER.min_damping, LAST, damped.at)
        spent += minimum.iterations
    spent += nearer.iterations + damped.iterations
    if remaining(minimum, bounded)[1] > options.unfinished:
        finer = replace(last, steps=2 * last.steps)
        try:
            minimum, last = finer.minimise(minimum.x, options.ftol, MINIMISER.min_damping, LAST), finer
        except ConvergenceError:
            pass  # the remaining distance widens the standard errors
        else:
            spent += minimum.iterations
    return _fit(last, minimum, outliers, COVARIANCE, spent, options.test_zeros and not model.zeros)


def _fit(
    problem: ChainProblem,
    minimum: Minimum,
    outliers: int,
    options: CovarianceOptions,
    iterations: int,
    test_zeros: bool,
) -> ChainFit:
    x, count = minimum.x, problem.count
    positions = problem.positions(x)
    assert positions is not None  # the motion at the minimum is finite
    residuals = [
        weight.T * np.where(period.valid, period.position - position, 0.0)
        for period, position, weight in zip(problem.periods, positions, problem.weights, strict=True)
    ]
    lags = correlation_time(residuals, options)
    longest = max(period.samples for period in problem.periods)
    window = max(lags, min(options.max_lag, int(options.min_window_share * longest)))
    samples = int(sum(float(np.sum(np.where(period.valid, repeated(period) ** 2, 0.0))) for period in problem.periods))
    slopes = np.diag(problem.coordinates.slopes(x[:count]))
    structured = sum(float(np.sum(structured_share(each) * np.sum(each**2, axis=1))) for each in residuals)
    white = robust_covariance(minimum.at, None, samples, count)
    covariance = coloured_covariance(problem, x, minimum.at.normal)[:count, :count]
    if structured > 0.0:  # model errors recur, and their size may vary over time
        robust = robust_covariance(minimum.at, problem.scatter(x, window), samples, count, structured)
        covariance = _larger(covariance, robust)
    step, decrease = remaining(minimum, problem.coordinates)
    value = problem.coordinates.values(x[:count])
    widened, missing = by_parameters(covariance, slopes, value), slopes @ step[:count]
    return ChainFit(
        value,
        widened,
        missing,
        by_parameters(white, slopes, value),
        tuple(problem.start(x, index) for index in range(len(problem.periods))),
        positions,
        outliers,
        float(lags),
        iterations,
        problem.softness,
        decrease,
        neglected_covariance(problem, x),
        _at_bound(problem, minimum, value, np.sqrt(np.diag(widened))),
        held_zeros(problem, x, decrease) if test_zeros and problem.model.joints > 1 else None,
    )


def _at_bound(problem: ChainProblem, minimum: Minimum, value: Array, std: Array) -> tuple[str, ...]:
    """Return the parameters that are at a bound although the data favour values beyond it, if this affects base
    parameters or viscous or dry friction.

    std: standard errors of the parameters `value` (parameters,).
    """
    names, base = problem.coordinates.names, problem.model.base
    found = list(limited(base, dict(zip(names, value.tolist(), strict=True)), std))
    slopes = np.diag(problem.coordinates.slopes(minimum.x[: value.size]))
    step, white = step_beyond(minimum.at.normal, minimum.at.gradient, slopes)
    used = np.array([index < base.count or kind_of(name) in ("viscous", "coulomb") for index, name in enumerate(names)])
    lower = np.where(problem.coordinates.positive, 0.0, -np.inf)
    beyond = beyond_range(value, step, white, lower, np.full(value.size, np.inf))
    # The bound itself may cause a misfit that makes the parameter's standard error larger than the step beyond it.
    if beyond[used].any() or np.any(np.abs(step[used]) > MOVED * finite_std(std, white)[used]):
        found += [name for name, over in zip(names, beyond, strict=True) if over]
    return tuple(found)


def _larger(one: Array, other: Array) -> Array:
    """Return a covariance at least as large as both arguments; infinite where either is infinite."""
    length = np.sqrt(np.maximum(np.diag(one), np.diag(other)))
    known = np.flatnonzero(np.isfinite(length) & (length > 0.0))
    at, lengths = np.ix_(known, known), np.outer(length[known], length[known])
    covariance = np.where(np.isfinite(one), other, one)
    covariance[at] = larger_covariance(other[at] / lengths, one[at] / lengths) * lengths
    return covariance
