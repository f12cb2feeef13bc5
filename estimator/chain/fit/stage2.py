"""Stage 2 for chains: maximum likelihood of one-step-ahead position predictions, starting from stage 1.

The observer starts stiff, so that the simulation can follow the motion with stage 1's parameters, and is softened as
the fit improves. Most iterations use coarse integration steps; the last ones use fine steps. The noise level of each
joint is itself estimated before the final iterations, in which outliers are downweighted (Huber).

Where joints often stick, stage 1's estimate of friction can be far off, and with it the link parameters and torque
scales, which are correlated with friction. Softening the observer while the shape of friction is fixed then leads the
fit into another minimum, in a curved valley where it stops short. So if the soft observer does not explain the motion,
a second start is made from the prior's links, with the shape of friction free as soon as the stiffest observer follows
the motion. The better of the two fits is continued.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import ChainCoordinates, kind_of
from hil.estimator.chain.fit.held_zeros import HeldZeros, held_zeros
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.remaining import remaining
from hil.estimator.chain.fit.resolved_widths import resolved_widths
from hil.estimator.chain.fit.stage1 import ChainLinear
from hil.estimator.chain.fit.uncertainty import coloured_covariance, neglected_covariance
from hil.estimator.chain.model.chain_model import ADDED_MASS, ChainModel
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
from hil.estimator.options import CoordinateOptions, CovarianceOptions, MinimiserOptions
from hil.estimator.simulation.arm import steps_per_sample

START = {"stribeck_rise": 0.2, "stribeck_velocity": 0.2, "load": 0.02, "torque_scale": 1.0, ADDED_MASS: 1.0}
START |= {"back_emf": 0.92, "lag_ratio": 1.0}


@dataclass(frozen=True)
class ChainOptions:
    """Options of the likelihood of chains; names as in `hil.estimator.options`."""

    softness: tuple[float, ...] = (3.0, 1.5, 1.0)
    """Natural frequencies of the observer, in order of use [Hz].

    A softer observer extracts more information; one that is too soft no longer follows the motion.
    """
    lost: float = 1.5
    """Cost increase, beyond what the softness explains, above which the previous observer is kept (a ratio)."""
    first_step: float = 5.2e-3
    """Integration step while the observer is stiff [s]; samples within it are skipped."""
    coarse_step: float = 2.6e-3
    """Integration step [s]."""
    fine_step: float = 1.3e-3
    """Integration step of the last iterations [s]."""
    finer: int = 16
    """Number of smaller steps that replace one near standstill, where friction changes fast."""
    finest: int = 64
    """Number of smaller steps that replace one near standstill in the last iterations."""
    widths_per_substep: float = CoordinateOptions.widths_per_substep
    width_floor: float = 3e-4
    """Minimum width of every Coulomb step [rad/s]: hardly distinguishable from friction that truly sticks."""
    initial_width: float = 0.03
    """Initial width of the smoothed Coulomb step [rad/s]."""
    other_initial_widths: tuple[float, ...] = (0.005, 0.001)
    """Initial widths of further fits, tried as long as no fit explains the motion [rad/s]."""
    poor: float = 1.2
    """RMS weighted residual above which a second start is made; 1 for noise alone."""
    test_zeros: bool = False
    """Whether to test the encoder zeros that the model holds fixed; takes one more simulation with sensitivities."""
    min_initial_lag: float = 5e-4
    """Minimum initial guess of the lag [s]."""
    reach: float = 0.3
    """Fraction of their maximum change per step that friction-shape parameters may use in the last iterations.

    The sum of squares is far from quadratic in them.
    """
    ftol_coarse: float = 1e-2
    ftol_near: float = 3e-3
    ftol_nearer: float = 1e-3
    ftol: float = 2e-5
    towards_prior: tuple[float, ...] = (1.0, 0.7, 0.4, 0.2, 0.0)
    """Initial guesses as fractions of the way from the prior to stage 1; the first that can be simulated is used."""
    unfinished: float = 1.0
    """Expected decrease of the sum of squares in one more step, above which the minimum counts as not reached and the
    fit continues with shorter integration steps. 1 is a distance of one standard error.
    """
    angle_scale: float = 0.1
    """Scale of the initial angles [rad]."""
    outlier_threshold: float = 4.0
    """Residual in standard deviations above which a sample is downweighted."""


DEFAULTS = ChainOptions()
REPEATED = 4  # consecutive equal readings that still count in full: a moving joint produces as many
MINIMISER, COVARIANCE = MinimiserOptions(), CovarianceOptions()
NEARER, LAST = MinimiserOptions(max_damping=0.1), MinimiserOptions(max_damping=1.0)
"""Options of the last iterations with coarse steps, and of those with fine steps that follow.

Where a joint is on the verge of sticking, the sum of squares is slightly discontinuous. A decrease that is only
achieved with heavy damping is such a discontinuity and is not pursued.
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
    """Number of samples over which the residual is correlated; 1 is white."""
    iterations: int
    """Number of simulations with derivatives."""
    softness: float
    """Natural frequency of the observer at the end [Hz]."""
    remaining: float
    """Decrease of the sum of squares that is expected from one more step, the one that would reach the minimum."""
    neglected: Array
    """Covariance due to what the model of voltage-driven joints neglects (parameters, parameters) [SI]."""
    at_bound: tuple[str, ...] = ()
    """Parameters at a bound although the data favour values beyond it, if base parameters depend on them."""
    held_zeros: HeldZeros | None = None
    """Result of the test of the encoder zeros that the model holds fixed; None if it fits them, has one joint, or no
    test was requested.
    """

    @property
    def total_covariance(self) -> Array:
        """Covariance of `value` about the truth: that at the minimum, widened by the distance to the minimum and by
        what the model is known to neglect.
        """
        return np.asarray(self.covariance + np.outer(self.missing, self.missing) + self.neglected)

    @property
    def reached(self) -> bool:
        """Whether the fit has reached its minimum: another step would change it by less than a standard error."""
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
    problem, x = _problem(periods, model, linear, prior, options)
    problem = replace(problem, added=tuple(added))
    # Undivided steps cannot resolve friction near standstill: its shape, fitted to them, would end up far away in a
    # curved valley, along which the later fits progress slowly.
    coarse = replace(problem, steps=_steps(periods, options.coarse_step), reach=0.0)
    if near is None:
        sticking, rough, spent = _started(coarse, x, options)
    else:
        soft = _narrowed(problem, near, options)
        sticking, rough, spent = _resolved(replace(coarse, softness=near.softness), soft, options)
        spent += near.iterations
    bounded = sticking.coordinates
    positions = sticking.positions(rough.x)
    assert positions is not None  # the minimum's motion is finite
    weights, outliers = noise_weights(periods, positions, options.outlier_threshold)
    weights = tuple((weight * _repeated(each)).T for weight, each in zip(weights, periods, strict=True))
    nearer = replace(sticking, weights=weights, reach=options.reach).minimise(
        rough.x, options.ftol_nearer, options=NEARER
    )
    last = replace(sticking, weights=weights, steps=problem.steps, finer=options.finest, reach=options.reach)
    damped = last.minimise(nearer.x, options.ftol, options=LAST)
    # Damping holds back poorly determined coordinates, so it is removed now. Had it been absent from the beginning,
    # many coordinates would reach their step limits and hold up the others.
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
            pass  # what remains widens the standard errors
        else:
            spent += minimum.iterations
    return _fit(last, minimum, outliers, COVARIANCE, spent, options.test_zeros and not model.zeros)


def _started(coarse: ChainProblem, x: Array, options: ChainOptions) -> tuple[ChainProblem, Minimum, int]:
    """Return the problem with friction near standstill resolved, its rough minimum, and the number of simulations.

    x: stage 1's result. Raises ConvergenceError if the stiffest observer does not follow the motion.
    """
    soft, softness, spent = _softened(coarse, _towards_prior(coarse, x, options), options)
    problem, found, more = _resolved(replace(coarse, softness=softness), soft, options)
    spent += more
    level = _level(problem, found.x)
    if level <= options.poor:
        return problem, found, spent
    with suppress(ConvergenceError):
        other, again, more = _softened_later(coarse, x, options)
        spent += more
        # The same errors leave larger residuals under a softer observer, by about the ratio of the frequencies.
        if _level(other, again.x) * other.softness < level * softness:
            return other, again, spent
    return problem, found, spent


def _softened_later(coarse: ChainProblem, x: Array, options: ChainOptions) -> tuple[ChainProblem, Minimum, int]:
    """Start from the prior's links, and free the shape of friction before the observer is softened; see `_started`."""
    start = _towards_prior(coarse, x, replace(options, towards_prior=(0.0,)))
    stiff, softness, spent = _softened(coarse, start, replace(options, softness=options.softness[:1]))
    problem, found, more = _resolved(replace(coarse, softness=softness), stiff, options)
    spent += more
    every_sample = replace(options, first_step=0.0, ftol_coarse=options.ftol_near, softness=options.softness[1:])
    soft, softness, more = _softened(problem, found.x, every_sample)
    problem = replace(problem, softness=softness)
    found, _ = _minimised(problem, soft, options.ftol_near)
    return problem, found, spent + more + found.iterations


def _resolved(coarse: ChainProblem, soft: Array, options: ChainOptions) -> tuple[ChainProblem, Minimum, int]:
    """Return the problem with the shape of friction free and motion near standstill resolved, its minimum from `soft`,
    and the number of simulations.
    """
    resolved = resolved_widths(coarse, soft, options.fine_step / options.finest, options.widths_per_substep)
    # An early fit may be far off: where it makes a joint much too light, the friction step must not stay wide.
    floor = np.clip(resolved, options.width_floor, options.initial_width)
    bounded = replace(coarse.coordinates, width_floor=floor)
    soft = bounded.raised(soft)
    sticking = replace(coarse, coordinates=bounded, finer=options.finer, reach=1.0)
    found, _ = _minimised(sticking, soft, options.ftol_near)
    return sticking, found, found.iterations


def _level(problem: ChainProblem, x: Array) -> float:
    """Return the RMS weighted residual at `x`; 1 for noise alone."""
    return float(np.sqrt(replace(problem, prior_weight=0.0).cost(x) / problem.counted))


def _narrowed(problem: ChainProblem, near: ChainFit, options: ChainOptions) -> Array:
    """Return the coordinates of an earlier fit, with Coulomb steps no wider than the initial width."""
    kinds = np.array([kind_of(name) for name in problem.coordinates.names])
    value = np.where(kinds == "coulomb_width", np.minimum(near.value, options.initial_width), near.value)
    starts = [start.reshape(-1) / problem.state_scale for start in near.starts]
    return np.concatenate((problem.coordinates.coordinates(value), *starts))


def _softened(coarse: ChainProblem, x: Array, options: ChainOptions) -> tuple[Array, float, int]:
    """Return the minimum with the softest observer that follows the motion, its softness and the number of simulations.

    Raises ConvergenceError if even the stiffest does not.
    """
    skip = max(1, int(options.first_step * min(period.rate for period in coarse.periods)))
    spent = 0
    cost: float | None = None
    softness = options.softness[0]
    for frequency in options.softness:
        last = frequency == options.softness[-1]
        every = 1 if last or coarse.steps > 1 else skip
        try:
            found, trial = _minimised(replace(coarse, softness=frequency, every=every), x, options.ftol_coarse)
        except ConvergenceError:
            if cost is None:
                raise
            break
        spent += found.iterations
        # The prior's weight differs from trial to trial, so only the residuals are compared.
        of_data = (found.at.cost - trial.prior_cost(found.x)) * every
        growth = options.lost * (softness / frequency) ** 2
        if cost is not None and of_data > growth * (cost + x.size):
            break
        x, softness, cost = found.x, frequency, of_data
    return x, softness, spent


def _minimised(problem: ChainProblem, x: Array, ftol: float) -> tuple[Minimum, ChainProblem]:
    """Return the minimum from `x` with the prior's weight raised by the residual there, and that problem."""
    trial, at = problem.tempered(x)
    found = trial.minimise(x, ftol, at=at)
    return replace(found, iterations=found.iterations + 1), trial


def _problem(
    periods: Sequence[SettledPeriod], model: ChainModel, linear: ChainLinear, prior: Prior, options: ChainOptions
) -> tuple[ChainProblem, Array]:
    """Return the problem, with every sample weighted by the known noise, and the initial guess."""
    velocity = float(np.sqrt(np.mean([np.mean(motion.velocity**2) for motion in linear.motions])))
    scales = np.concatenate((np.maximum(prior.std, 1e-9), np.ones(len(model.names) - prior.std.size)))
    coordinates = ChainCoordinates(model.names, scales, np.full(model.joints, options.width_floor))
    state_scale = np.repeat([options.angle_scale, velocity], model.joints)
    known = dict(zip(model.linear_names, linear.value.tolist(), strict=True))
    known |= {
        "lag": max(linear.delay, options.min_initial_lag),
        "delay": linear.delay if model.drive == "delay" else 0.0,
    }
    start = START | {"coulomb_width": options.initial_width}
    value = np.array([known.get(name, start.get(kind_of(name), 0.0)) for name in model.names])
    states = [np.concatenate((m.position[:, 0], m.velocity[:, 0])) / state_scale for m in linear.motions]
    weights = tuple(np.where(period.valid, _repeated(period) / period.noise[:, None], 0.0).T for period in periods)
    steps = _steps(periods, options.fine_step)
    problem = ChainProblem(
        tuple(periods), model, coordinates, prior, state_scale, weights, steps, softness=options.softness[0]
    )
    return problem, np.concatenate((coordinates.coordinates(value), *states))


def _towards_prior(problem: ChainProblem, x: Array, options: ChainOptions) -> Array:
    """Return stage 1's point, moved towards the prior until the arm can be simulated.

    If the data hardly determine some inertias, the estimates may be unphysical, with an indefinite mass matrix.
    """
    count = problem.model.base.count
    likely = problem.prior.value / problem.coordinates.scales[:count]
    for share in options.towards_prior:
        moved = x.copy()
        moved[:count] = likely + share * (x[:count] - likely)
        if problem.positions(moved) is not None:
            return moved
    return x


def _steps(periods: Sequence[SettledPeriod], longest: float) -> int:
    return max(steps_per_sample(period.rate, longest) for period in periods)


def _repeated(period: SettledPeriod) -> Array:
    """Return the weight of each sample (joints, samples), less than 1 if it shares its error with its neighbours.

    While a joint sticks, its encoder repeats one reading with one rounding error. Counted at every sample, that error
    would make the simulated joint creep towards the reading, through friction that is smoothed near standstill.
    Therefore any number of equal readings in a row counts as at most REPEATED readings.
    """
    weight = np.ones_like(period.position)
    for row, position in zip(weight, period.position, strict=True):
        first = np.flatnonzero(np.concatenate(([True], np.diff(position) != 0.0)))  # NaN differs from itself
        length = np.diff(np.concatenate((first, [position.size])))
        row[:] = np.repeat(np.minimum(1.0, np.sqrt(REPEATED / length)), length)
    return weight


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
    assert positions is not None  # the minimum's motion is finite
    residuals = [
        weight.T * np.where(period.valid, period.position - position, 0.0)
        for period, position, weight in zip(problem.periods, positions, problem.weights, strict=True)
    ]
    lags = correlation_time(residuals, options)
    longest = max(period.samples for period in problem.periods)
    window = max(lags, min(options.max_lag, int(options.min_window_share * longest)))
    samples = int(sum(float(np.sum(np.where(period.valid, _repeated(period) ** 2, 0.0))) for period in problem.periods))
    slopes = np.diag(problem.coordinates.slopes(x[:count]))
    structured = sum(float(np.sum(structured_share(each) * np.sum(each**2, axis=1))) for each in residuals)
    white = robust_covariance(minimum.at, None, samples, count)
    covariance = coloured_covariance(problem, x, minimum.at.normal)[:count, :count]
    if structured > 0.0:  # a model error repeats itself, and its size may vary over time
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
    """Return the parameters at a bound although the data favour values beyond it, if base parameters, viscous or dry
    friction depend on them or are among them.

    std: standard errors of the parameters `value` (parameters,).
    """
    names, base = problem.coordinates.names, problem.model.base
    found = list(limited(base, dict(zip(names, value.tolist(), strict=True)), std))
    slopes = np.diag(problem.coordinates.slopes(minimum.x[: value.size]))
    step, white = step_beyond(minimum.at.normal, minimum.at.gradient, slopes)
    used = np.array([index < base.count or kind_of(name) in ("viscous", "coulomb") for index, name in enumerate(names)])
    if np.any(np.abs(step[used]) > MOVED * finite_std(std, white)[used]):
        lower = np.where(problem.coordinates.positive, 0.0, -np.inf)
        beyond = beyond_range(value, step, white, lower, np.full(value.size, np.inf))
        found += [name for name, over in zip(names, beyond, strict=True) if over]
    return tuple(found)


def _larger(one: Array, other: Array) -> Array:
    """Return a covariance at least as large as both; infinite where one of them is."""
    length = np.sqrt(np.maximum(np.diag(one), np.diag(other)))
    known = np.flatnonzero(np.isfinite(length) & (length > 0.0))
    at, lengths = np.ix_(known, known), np.outer(length[known], length[known])
    covariance = np.where(np.isfinite(one), other, one)
    covariance[at] = larger_covariance(other[at] / lengths, one[at] / lengths) * lengths
    return covariance
