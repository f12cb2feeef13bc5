"""Stage 2: maximum likelihood, that is, least squares of measured minus simulated position over settled periods.

If position errors are independent and identically distributed, as rounding errors nearly are, the most likely
parameters minimise the weighted sum of squares. The initial state of each run is estimated as well: simulating until
the motion is periodic would take two or more periods instead of one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.covariance import (
    by_parameters,
    correlation_time,
    inflation,
    robust_covariance,
    structured_share,
)
from hil.estimator.fit.levenberg_marquardt import Minimum
from hil.estimator.fit.multistart import Refined, Search
from hil.estimator.fit.objective import Objective, Run
from hil.estimator.fit.reparametrisation import CoordinatePrior, Coordinates, Lever, Sizes, highest_values, scales_of
from hil.estimator.fit.resolved_widths import resolved_widths
from hil.estimator.fit.ripple import WAVES, find_waves
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.fit.stabilised_run import StabilisedRun
from hil.estimator.fit.stage1 import LinearEstimate
from hil.estimator.models.bounds import beyond_range, finite_std, matters, scaled_inverse, step_beyond
from hil.estimator.models.model import LEVER_DOUBTED, Model
from hil.estimator.models.terms import FRICTIONS, term_of
from hil.estimator.options import LikelihoodOptions
from hil.estimator.simulation.back_emf import limited

DEFAULTS = LikelihoodOptions()
HARDLY = 0.05
"""Initial value of a term added to a model near its minimum, as a fraction of the term's usual initial guess."""


@dataclass(frozen=True)
class Fit:
    """Maximum-likelihood parameters under one model."""

    value: Array
    """Values in the order of `Model.names` [SI]."""
    covariance: Array
    """Covariance of `value`, also valid for correlated errors; infinite for parameters without effect on the motion."""
    starts: tuple[Array, ...]
    """State at the first sample of each run (2, joints) [rad, rad/s]."""
    positions: tuple[Array, ...]
    """Simulated positions of each run (joints, samples) [rad]."""
    outliers: int
    """Number of samples that were downweighted."""
    correlation_time: float
    """Number of samples over which the residual is correlated; 1 for white noise."""
    iterations: int
    """Number of simulations with derivatives."""
    at_bound: tuple[str, ...] = ()
    """Parameters at a bound although the data favour values beyond it; empty unless this affects base parameters."""


@dataclass(frozen=True)
class Near:
    """A point close to a minimum: the result of fitting a similar model to the same periods."""

    parameters: Mapping[str, float]
    """Parameters by name [SI]; others start from their usual initial guess."""
    state: Array
    """State at the first sample of the first period (2, joints) [rad, rad/s]."""


def fit_runs(
    periods: Sequence[SettledPeriod],
    model: Model,
    linear: LinearEstimate,
    *,
    coarse: bool = False,
    starts: Sequence[Mapping[str, float]] = (),
    near: Near | None = None,
    options: LikelihoodOptions = DEFAULTS,
) -> Fit:
    """Fit the parameters of `model` by maximum likelihood.

    Args:
        periods: settled periods of one arm.
        model: the model to fit.
        linear: stage 1's estimate for the same periods.
        coarse: whether to end the fit early if the residual is well above the noise; such a fit suffices to compare
            models.
        starts: additional initial guesses, parameters by name [SI], tried before all others.
        near: point known to be close to a minimum, used as the only initial guess.
        options: tolerances and limits.

    Returns:
        Parameters with their covariance, initial states and simulated motions.

    Raises:
        ConvergenceError: if no initial guess leads to a minimum.
    """
    fine, states = _objective(periods, model, linear, options)
    rough = replace(
        fine,
        runs=tuple(run.integrated(options.coarse_integration) for run in fine.runs),
        max_relative_decrease=options.max_relative_decrease_coarse,
    )
    if near is not None:
        x = fine.coordinates.coordinates(_near_values(model, linear, near.parameters, options))
        states[: fine.state_scale.size] = near.state.reshape(-1) / fine.state_scale
        refined, minimum = Search(periods, fine, rough, options, coarse).nearest(np.concatenate((x, states)))
        return _fit(periods, refined, minimum, options, options.ftol_coarse if coarse else options.ftol_refine)
    guesses = [np.concatenate((x, states)) for x in _initial_guesses(fine, periods, model, linear, starts, options)]
    search = Search(periods, fine, rough, options, coarse)
    refined, minimum = search.minimum(guesses, _springs(linear, options))
    return _fit(periods, refined, minimum, options, options.ftol_coarse if coarse else options.ftol_refine)


def _near_values(
    model: Model, linear: LinearEstimate, parameters: Mapping[str, float], options: LikelihoodOptions
) -> Array:
    narrow = _standstill_guesses(linear, options)[0]
    unnamed = dict(zip(model.names, _guess(model, linear, {}, narrow, options).tolist(), strict=True))
    # Terms that the simpler model lacks start close to zero; otherwise the first step would leave its minimum.
    hardly = {name: HARDLY * value for name, value in unnamed.items() if _is_nothing_when_small(name)}
    return np.array([{**unnamed, **hardly, **parameters}[name] for name in model.names])


def _is_nothing_when_small(name: str) -> bool:
    """Return whether a parameter has an initial guess and its term vanishes as the parameter goes to zero."""
    term = term_of(name)
    return term.range == "positive" and term.part in FRICTIONS and not term.standstill and bool(term.initial)


def _springs(linear: LinearEstimate, options: LikelihoodOptions) -> Array:
    """Return the stiffness (joints,) [N m/rad] of springs that give each joint the tracking frequency."""
    inertia = [abs(linear.value[i]) for i, name in enumerate(linear.names) if name.startswith("inertia")]
    stiffness: Array = np.array(inertia) * (2.0 * np.pi * options.tracking_frequency) ** 2
    return stiffness


def _objective(
    periods: Sequence[SettledPeriod], model: Model, linear: LinearEstimate, options: LikelihoodOptions
) -> tuple[Objective, Array]:
    """Return the objective, with samples weighted by the known noise, and initial guesses of the initial states."""
    velocity = float(np.sqrt(np.mean([np.mean(motion.velocity**2) for motion in linear.motions])))
    torque = float(np.sqrt(np.mean([np.mean(period.torque**2) for period in periods])))
    sizes = Sizes(torque, velocity, abs(float(linear.value[0])))
    scales = scales_of(model.names, sizes)
    state_scale = np.repeat([options.angle_scale, velocity], model.joints)
    states = [np.concatenate((m.position[:, 0], m.velocity[:, 0])) / state_scale for m in linear.motions]
    weights = tuple(np.where(period.valid, 1.0 / period.noise[:, None], 0.0) for period in periods)
    runs = tuple(_simulated(period, options) for period in periods)
    speeds = np.max([np.abs(motion.velocity).max(axis=1) for motion in linear.motions], axis=0)
    bounds = _resolved_widths(model, linear, options), highest_values(model.names, speeds)
    coordinates = Coordinates(model.names, scales, options.coordinates, *bounds)
    steps = options.minimiser, options.max_relative_decrease
    prior = CoordinatePrior.of(model.names, scales, sizes)
    weight = dict(zip(linear.names, linear.value.tolist(), strict=True)).get("gravity_2", 0.0)
    lever = Lever.of(model, weight, sizes)
    objective = Objective(runs, coordinates, state_scale, weights, prior, *steps, lever=lever)
    return objective, np.concatenate(states)


def _resolved_widths(model: Model, linear: LinearEstimate, options: LikelihoodOptions) -> Array:
    return resolved_widths(
        model.names,
        dict(zip(linear.names, linear.value.tolist(), strict=True)),
        options.integration.max_step,
        options.coordinates.widths_per_substep,
        options.integration.max_substeps,
    )


def _simulated(period: SettledPeriod, options: LikelihoodOptions) -> Run:
    if period.stabiliser is None:
        return SimulatedRun.of(period, options.integration)
    return StabilisedRun.of(period, period.stabiliser, options.integration)


def _initial_guesses(
    objective: Objective,
    periods: Sequence[SettledPeriod],
    model: Model,
    linear: LinearEstimate,
    starts: Sequence[Mapping[str, float]],
    options: LikelihoodOptions,
) -> list[Array]:
    """Return initial guesses (coordinates): the caller's, then stage 1's with a narrow and a wide friction step."""
    waves: dict[str, float] = {}
    for wave in WAVES:
        waves |= find_waves(periods, linear, wave) if wave in model.options else {}
    own = [_guess(model, linear, waves, standstill, options) for standstill in _standstill_guesses(linear, options)]
    unnamed = dict(zip(model.names, own[0].tolist(), strict=True))
    given = [np.array([{**unnamed, **start}[name] for name in model.names]) for start in starts]
    return [objective.coordinates.coordinates(value) for value in (*given, *own)]


def _standstill_guesses(linear: LinearEstimate, options: LikelihoodOptions) -> list[dict[str, float]]:
    """Return initial guesses of friction near standstill for every joint, first narrow, then wide."""
    viscous, coulomb = (
        float(np.mean([abs(linear.value[i]) for i, name in enumerate(linear.names) if name.startswith(kind)]))
        for kind in ("viscous", "coulomb")
    )
    return [
        {"coulomb_width": width, "presliding_stiffness": coulomb / bend, "presliding_damping": viscous}
        for width, bend in zip(options.initial_widths, options.initial_bends, strict=True)
    ]


def _guess(
    model: Model,
    linear: LinearEstimate,
    waves: Mapping[str, float],
    standstill: Mapping[str, float],
    options: LikelihoodOptions,
) -> Array:
    """Return an initial guess (parameters,) [SI]: stage 1's values, and defaults for other parameters."""
    known = dict(zip(linear.names, linear.value.tolist(), strict=True)) | dict(waves)
    known |= {f"{name}_{joint + 1}": value for name, value in standstill.items() for joint in range(model.joints)}
    if model.drive == "delay":
        known["delay"] = linear.delay
    known["lag"] = max(linear.delay, options.min_initial_lag)
    return np.array([known.get(name, term_of(name).initial) for name in model.names])


@dataclass(frozen=True)
class _Errors:
    """Model error and correlation of the residual at a minimum, according to `hil.estimator.fit.covariance`."""

    lags: int
    samples: int
    scatter: Array
    structured: float
    """Part of the sum of squares that is due to model errors."""
    expected: Array
    """Contribution of the priors to the normal equations (coordinates, coordinates)."""


def _errors(
    periods: Sequence[SettledPeriod],
    objective: Objective,
    x: Array,
    positions: Sequence[Array],
    options: LikelihoodOptions,
) -> _Errors:
    residuals = [
        weight * np.where(period.valid, period.position - position, 0.0)
        for period, position, weight in zip(periods, positions, objective.weights, strict=True)
    ]
    correlation = options.covariance
    lags = correlation_time(residuals, correlation)
    longest = max(period.samples for period in periods)
    window = max(lags, min(correlation.max_lag, int(correlation.min_window_share * longest)))
    structured = sum(
        float(np.sum(_model_error(each, weight, period)))
        for each, weight, period in zip(residuals, objective.weights, periods, strict=True)
    )
    expected = np.zeros((x.size, x.size))
    expected[: objective.count, : objective.count] = objective.expected_normal(x)
    samples = int(sum(period.valid.sum() for period in periods))
    return _Errors(lags, samples, objective.scatter(x, window), structured, expected)


def _fit(
    periods: Sequence[SettledPeriod],
    refined: Refined,
    minimum: Minimum,
    options: LikelihoodOptions,
    ftol: float | None = None,
) -> Fit:
    """Return the fit at `minimum`, or at the new minimum if `ftol` is given and reweighting the priors moves it."""
    objective, x, count = refined.weighted, minimum.x, refined.weighted.count
    positions = objective.positions(x)
    errors = _errors(periods, objective, x, positions, options)
    if ftol is not None and (doubted := _doubting(objective, minimum, errors)) is not objective:
        try:
            found = doubted.minimise(x, ftol)
        except ConvergenceError:
            found = Minimum(x, doubted.evaluate(x), minimum.iterations)
        return _fit(periods, replace(refined, weighted=doubted), found, options, ftol)
    if ftol is not None:
        fitted = _tempered(objective, minimum, errors, options, ftol)
        if fitted is not minimum:
            return _fit(periods, refined, fitted, options)
    covariance = robust_covariance(
        minimum.at, errors.scatter, errors.samples, count, errors.structured, errors.expected
    )
    coordinates = objective.coordinates
    value = coordinates.values(x[:count])
    widened = by_parameters(covariance, coordinates.slopes(x[:count]), value, coordinates.floored)
    return Fit(
        value,
        widened,
        tuple(objective.start(x, run) for run in range(len(periods))),
        positions,
        refined.outliers,
        float(errors.lags),
        minimum.iterations,
        _at_bound(coordinates, minimum, value, np.sqrt(np.diag(widened))),
    )


def _at_bound(coordinates: Coordinates, minimum: Minimum, value: Array, std: Array) -> tuple[str, ...]:
    """Return the parameters that are at a bound although the data favour values beyond it, provided that this affects
    base parameters.

    std: standard errors of the parameters `value` (parameters,).
    """
    names = coordinates.names
    step, white = step_beyond(minimum.at.normal, minimum.at.gradient, coordinates.slopes(minimum.x[: value.size]))
    beyond = beyond_range(value, step, white, *coordinates.ranges(value))
    if not (beyond.any() and matters(names, beyond, step, finite_std(std, white))):
        beyond[:] = False
    late = limited(dict(zip(names, value.tolist(), strict=True)))
    return tuple(name for name, over in zip(names, beyond, strict=True) if over or name in late)


def _doubting(objective: Objective, minimum: Minimum, errors: _Errors) -> Objective:
    """Return the objective, with a wider prior on the length of link 1 if the motion contradicts that prior.

    In a small motion, a wrong length would otherwise practically determine the coupling, because the estimate from the
    motion alone differs from the value implied by the length by little more than its standard error. The prior's
    variance is increased until a difference of this size is typical.
    """
    lever = objective.lever
    if lever is None or lever.is_doubted:
        return objective
    count, x = objective.count, minimum.x
    away, slope = lever.residual(objective.coordinates.values(x[:count]))
    along = np.zeros(x.size)
    along[:count] = slope @ objective.coordinates.slopes(x[:count])
    inverse, scale = scaled_inverse(minimum.at.normal - np.outer(along, along))
    gradient, along = (minimum.at.gradient - away * along) / scale, along / scale
    alone = away - float(along @ inverse @ gradient)
    factor = inflation(minimum.at, errors.scatter, errors.samples, errors.structured, errors.expected)
    variance = float(factor[[lever.coupling, lever.gravity]].max()) * float(along @ inverse @ along)
    if alone**2 < LEVER_DOUBTED**2 * (1.0 + variance):
        return objective
    wider = lever.std * float(np.sqrt(max(1.0, alone**2 - variance)))
    return replace(objective, lever=replace(lever, std=wider, is_doubted=True))


def _tempered(
    objective: Objective, minimum: Minimum, errors: _Errors, options: LikelihoodOptions, ftol: float
) -> Minimum:
    """Return the minimum with priors reweighted by the data's actual information; `minimum` if nothing changes.

    The sum of squares treats the errors of all samples as independent, but a model error repeats at every reversal. The
    data therefore constrain a parameter far less than the sum implies, and the fit would override any prior. To prevent
    this, each prior's precision is multiplied by the ratio of the data's variance to that of independent errors.
    """
    count, prior = objective.count, objective.prior
    if objective.lever is None and not prior.precision.any():
        return minimum
    factor = inflation(minimum.at, errors.scatter, errors.samples, errors.structured, errors.expected)[:count]
    if float(factor.max()) < options.least_inflation:
        return minimum
    heavier = objective.with_prior_weighted(factor)
    x = minimum.x
    if heavier.cost_at(x) - objective.cost_at(x) < options.least_tempering * minimum.at.cost:
        return minimum
    try:
        found = heavier.minimise(x, ftol)
    except ConvergenceError:
        return minimum
    return Minimum(found.x, objective.evaluate(found.x), minimum.iterations + found.iterations)


def _model_error(residual: Array, weight: Array, period: SettledPeriod) -> Array:
    """Return the part of each joint's weighted sum of squares that is due to model errors (joints,).

    This is the part that is not white, limited to the excess over the noise, since the rounding errors of slow joints
    are not white either.
    """
    squares = np.sum(residual**2, axis=1)
    noise = np.sum((weight * period.noise[:, None]) ** 2, axis=1)
    error: Array = np.minimum(structured_share(residual) * squares, np.maximum(squares - noise, 0.0))
    return error
