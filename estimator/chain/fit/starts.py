"""Start of stage 2 for chains: from stage 1's result to a rough minimum with a soft observer.

The observer starts stiff, so that stage 1's parameters suffice to follow the motion, and is softened as the fit
improves.

If joints often stick, stage 1's estimate of friction can be far off. Softening the observer while the shape of friction
is fixed then leads the fit into a curved valley. So if the soft observer does not explain the motion, a second fit
starts from the prior's links, and the shape of friction is fitted as soon as the stiffest observer follows the motion.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import SHAPES, ChainCoordinates, kind_of
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.options import ChainOptions
from hil.estimator.chain.fit.resolved_widths import resolved_widths
from hil.estimator.chain.fit.stage1 import ChainLinear
from hil.estimator.chain.model.chain_model import ADDED_MASS, ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.levenberg_marquardt import Minimum
from hil.estimator.simulation.arm import steps_per_sample

START = {"stribeck_rise": 0.2, "stribeck_velocity": 0.2, "load": 0.02, "torque_scale": 1.0, ADDED_MASS: 1.0}
START |= {"back_emf": 0.92, "lag_ratio": 1.0}
REPEATED = 4  # consecutive equal readings that count in full: a moving joint can produce this many


def first_problem(
    periods: Sequence[SettledPeriod], model: ChainModel, linear: ChainLinear, prior: Prior, options: ChainOptions
) -> tuple[ChainProblem, Array]:
    """Return the problem, with every sample weighted by the known noise, and the initial guess."""
    velocity = float(np.sqrt(np.mean([np.mean(motion.velocity**2) for motion in linear.motions])))
    scales = np.concatenate((np.maximum(prior.std, 1e-9), np.ones(len(model.names) - prior.std.size)))
    coordinates = ChainCoordinates(model.names, scales, np.full(model.joints, options.width_floor))
    state_scale = np.repeat([options.angle_scale, velocity], model.joints)
    known = dict(zip(model.linear_names, linear.value.tolist(), strict=True))
    known |= {
        "lag": initial_lag(linear.delay, options),
        "delay": linear.delay if model.drive == "delay" else 0.0,
    }
    start = START | {"coulomb_width": options.initial_width}
    value = np.array([known.get(name, start.get(kind_of(name), 0.0)) for name in model.names])
    states = [np.concatenate((m.position[:, 0], m.velocity[:, 0])) / state_scale for m in linear.motions]
    weights = tuple(np.where(period.valid, repeated(period) / period.noise[:, None], 0.0).T for period in periods)
    steps = integration_steps(periods, options.fine_step)
    problem = ChainProblem(
        tuple(periods), model, coordinates, prior, state_scale, weights, steps, softness=options.softness[0]
    )
    return problem, np.concatenate((coordinates.coordinates(value), *states))


def initial_lag(delay: float, options: ChainOptions) -> float:
    """Return the initial guess of the lag [s]: the geometric mean of stage 1's delay and the typical lag.

    Stage 1's delay is too long by several milliseconds.
    """
    least = options.min_initial_lag
    return max(math.sqrt(max(delay, least) * SHAPES["lag"][0]), least)


def integration_steps(periods: Sequence[SettledPeriod], longest: float) -> int:
    """Return the number of integration steps per sample, each no longer than `longest` [s]."""
    return max(steps_per_sample(period.rate, longest) for period in periods)


def repeated(period: SettledPeriod) -> Array:
    """Return the weight of each sample (joints, samples), less than 1 for a sample that shares its neighbours' error.

    While a joint sticks, its encoder repeats one reading with one rounding error. If this error counted at every
    sample, it would make the simulated joint creep towards the reading. Therefore any number of equal readings in a row
    counts as at most REPEATED readings.
    """
    weight = np.ones_like(period.position)
    for row, position in zip(weight, period.position, strict=True):
        first = np.flatnonzero(np.concatenate(([True], np.diff(position) != 0.0)))  # NaN differs from itself
        length = np.diff(np.concatenate((first, [position.size])))
        row[:] = np.repeat(np.minimum(1.0, np.sqrt(REPEATED / length)), length)
    return weight


def started(coarse: ChainProblem, x: Array, options: ChainOptions) -> tuple[ChainProblem, Minimum, int]:
    """Return the optimisation problem refined to resolve friction near standstill, its approximate minimum, and the
    number of simulations used.

    x: stage 1's result. Raises ConvergenceError if the stiffest observer does not follow the motion.
    """
    soft, softness, spent = softened(coarse, towards_prior(coarse, x, options), options)
    problem, found, more = resolved(replace(coarse, softness=softness), soft, options)
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
    """Start from the prior's links, and free the shape of friction before the observer is softened; see `started`."""
    start = towards_prior(coarse, x, replace(options, towards_prior=(0.0,)))
    stiff, softness, spent = softened(coarse, start, replace(options, softness=options.softness[:1]))
    problem, found, more = resolved(replace(coarse, softness=softness), stiff, options)
    spent += more
    every_sample = replace(options, first_step=0.0, ftol_coarse=options.ftol_near, softness=options.softness[1:])
    soft, softness, more = softened(problem, found.x, every_sample)
    problem = replace(problem, softness=softness)
    found, _ = _minimised(problem, soft, options.ftol_near)
    return problem, found, spent + more + found.iterations


def resolved(coarse: ChainProblem, soft: Array, options: ChainOptions) -> tuple[ChainProblem, Minimum, int]:
    """Refine the problem so that it fits the shape of friction and resolves motion near standstill.

    Returns the refined problem, the minimum found from `soft`, and the number of simulations used.
    """
    narrowest = resolved_widths(coarse, soft, options.fine_step / options.finest, options.widths_per_substep)
    # An early fit may be far off: if it makes a joint much too light, that joint's friction step must not stay wide.
    floor = np.clip(narrowest, options.width_floor, options.initial_width)
    bounded = replace(coarse.coordinates, width_floor=floor)
    soft = bounded.raised(soft)
    sticking = replace(coarse, coordinates=bounded, finer=options.finer, reach=1.0)
    found, _ = _minimised(sticking, soft, options.ftol_near)
    return sticking, found, found.iterations


def _level(problem: ChainProblem, x: Array) -> float:
    """Return the RMS weighted residual at `x`; 1 for noise alone."""
    return float(np.sqrt(_of_data(problem, x) / problem.counted))


def _of_data(problem: ChainProblem, x: Array) -> float:
    """Return the sum of squares at `x` without the prior's part; infinite if the motion diverges."""
    return replace(problem, prior_weight=0.0).cost(x)


def narrowed(problem: ChainProblem, value: Array, starts: Sequence[Array], options: ChainOptions) -> Array:
    """Return the coordinates of an earlier fit, with Coulomb steps no wider than the initial width.

    value, starts: the earlier fit's parameters (parameters,) and the state at the first sample of each period (2,
    joints) [SI].
    """
    kinds = np.array([kind_of(name) for name in problem.coordinates.names])
    value = np.where(kinds == "coulomb_width", np.minimum(value, options.initial_width), value)
    starts = [start.reshape(-1) / problem.state_scale for start in starts]
    return np.concatenate((problem.coordinates.coordinates(value), *starts))


def softened(coarse: ChainProblem, x: Array, options: ChainOptions) -> tuple[Array, float, int]:
    """Return a rough minimum with the softest observer that follows the motion, this observer's softness, and the
    number of simulations used.

    Raises ConvergenceError if even the stiffest observer does not follow the motion.
    """
    skip = max(1, int(options.first_step * min(period.rate for period in coarse.periods)))
    spent = 0
    cost: float | None = None
    softness = options.softness[0]
    for frequency in options.softness:
        last = frequency == options.softness[-1]
        every = 1 if last or coarse.steps > 1 else skip
        trial = replace(coarse, softness=frequency, every=every)
        growth = options.lost * (softness / frequency) ** 2
        # If this observer is good enough, no fit is needed here, since the subsequent fits start with it.
        if last and cost is not None and _of_data(trial, x) <= growth * (cost + x.size):
            return x, frequency, spent
        try:
            found, trial = _minimised(trial, x, options.ftol_coarse)
        except ConvergenceError:
            if cost is None:
                raise
            break
        spent += found.iterations
        # The prior's weight differs from trial to trial, so only the residuals are compared.
        of_data = (found.at.cost - trial.prior_cost(found.x)) * every
        if cost is not None and of_data > growth * (cost + x.size):
            break
        x, softness, cost = found.x, frequency, of_data
    return x, softness, spent


def _minimised(problem: ChainProblem, x: Array, ftol: float) -> tuple[Minimum, ChainProblem]:
    """Weight the prior by the residual at `x`; return the minimum found from there, and the weighted problem."""
    trial, at = problem.tempered(x)
    found = trial.minimise(x, ftol, at=at)
    return replace(found, iterations=found.iterations + 1), trial


def towards_prior(problem: ChainProblem, x: Array, options: ChainOptions) -> Array:
    """Return stage 1's estimate, moved towards the prior until the arm can be simulated.

    If the data barely constrain some inertias, the estimates may be unphysical, with an indefinite mass matrix.
    """
    count = problem.model.base.count
    likely = problem.prior.value / problem.coordinates.scales[:count]
    for share in options.towards_prior:
        moved = x.copy()
        moved[:count] = likely + share * (x[:count] - likely)
        if problem.positions(moved) is not None:
            return moved
    return x
