"""Stage 2: maximum likelihood, by least squares of measured minus simulated position over settled periods.

With errors of position that are alike and independent from sample to sample, as rounding nearly is, the
most likely parameters are those of the smallest weighted sum of squares. The state at the first sample of
each run is unknown too: simulating until the motion is periodic would take two or more periods in place of one.

Most of the way is gone in long steps of integration; short ones choose between what these cannot tell apart.
How large the errors are is itself estimated, joint by joint, before the last digits, and samples
far outside are weighed down there (Huber): a few wild readings then cost nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.covariance import (
    LONGEST_LAG,
    by_parameters,
    correlation_time,
    robust_covariance,
    structured_share,
)
from hil.estimator.fit.levenberg_marquardt import LEAST_DAMPING, Minimum
from hil.estimator.fit.objective import Problem, Run
from hil.estimator.fit.reparametrisation import Coordinates, scales_of
from hil.estimator.fit.ripple import find_ripple
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.fit.stabilised_run import StabilisedRun
from hil.estimator.fit.stage1 import LinearEstimate
from hil.estimator.models.model import Model
from hil.estimator.models.terms import TERMS, kind_of, term_of

WIDTH_FLOOR = 1e-4  # rad/s: friction that sticks is not told from this, and from 3e-4 by half a standard error
# From a narrow step the fit of a wide one may end in a local minimum, and the other way round: try both. With
# presliding, what matters is how far friction bends before it slides.
STARTING_WIDTHS = (0.005, 0.05)  # rad/s
STARTING_BENDS = (1e-3, 5e-3)  # rad
# An arm that swings past the upright amplifies what is still wrong: it is first held to the measured motion by springs
# that would give its joints this frequency. If what is found then is lost when the springs are gone, and leaves so many
# times more of the motion, the arm's free beginning is fitted before the whole.
PULL = 2.0  # Hz
LOST = 1.5
HORIZONS = (0.125, 0.25, 0.5)
LEAST_HORIZON = 10  # samples of all joints for each unknown
# Relative gains in the sum of squares at which a fit ends: of the first state alone, of a start, of the first and the
# second look at the whole, and of the end, where what is left to gain is a tenth of a standard error's worth over all
# parameters together.
ROUGHLY = 0.1
HASTY = 2e-2
COARSE = 3e-3
NEAR = 3e-4
FINE = 1e-5
# Sums of squares in units of the noise: two tries this close are one minimum, and this close only short steps tell.
SAME, CLOSE = 1.0, 25.0
HOPELESS = 2.0  # sum of squares per sample in units of the noise from which a hasty fit gives up
ALIKE = 1.01  # of the best try's sum of squares: up to here another try may still end lower
EXPLAINED = 1.03  # sum of squares per sample in units of the noise: nothing is left for another try to find
# Far from the end the sum is anything but quadratic in friction's width; in the short steps near the end it is nearly.
CAUTIOUS = 0.5
ANGLE_SCALE = 0.1  # rad
# Terms that shape friction near standstill, and of these the rise alone.
SHAPE = tuple(name for name, term in TERMS.items() if term.standstill)
STRIBECK = tuple(name for name, term in TERMS.items() if term.part == "stribeck")
LEAST_LAG = 1e-4  # s, at the start
LEAST_WINDOW = 0.005  # of a run: rounding is correlated, a little, over more lags than its autocorrelation shows
OUTLIER = 4.0  # standard deviations; rounding never leaves more than 1.7


@dataclass(frozen=True)
class Fit:
    """The most likely parameters under one model."""

    value: Array
    """In the order of `Model.names` [SI]."""
    covariance: Array
    """Of `value`, right for errors that are correlated too. Infinite for what leaves no trace."""
    white_covariance: Array
    """Of `value`, if every sample's error were independent and of the size that the noise has, model error or not."""
    starts: tuple[Array, ...]
    """Of each run, angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    positions: tuple[Array, ...]
    """Of each run, simulated positions (joints, samples) [rad]."""
    outliers: int
    """Samples that were weighed down."""
    correlation_time: float
    """Samples over which the residual is correlated; 1 is white."""
    iterations: int
    """Simulations with derivatives."""


def fit_runs(
    periods: Sequence[SettledPeriod],
    model: Model,
    linear: LinearEstimate,
    *,
    hasty: bool = False,
    starts: Sequence[Mapping[str, float]] = (),
) -> Fit:
    """The most likely parameters of `model`, from stage 1's `linear`. Raises ConvergenceError.

    `starts`: parameters from which further tries start, before all others. `hasty` is for trying a model: one that
    leaves much more than the noise is given up before its last digits.
    """
    problem, states = _problem(periods, model, linear)
    rough = replace(problem, runs=tuple(run.roughly() for run in problem.runs), narrowing=CAUTIOUS)
    samples = int(sum(period.valid.sum() for period in periods))
    ripple = find_ripple(periods, linear) if "ripple" in model.options else {}
    own = [_start(model, linear, ripple, shape) for shape in _shapes(linear)]
    unnamed = dict(zip(model.names, own[0].tolist(), strict=True))
    given = [np.array([{**unnamed, **start}[name] for name in model.names]) for start in starts]
    coordinates = [problem.coordinates.coordinates(value) for value in (*given, *own)]
    ways = _ways(rough, [np.concatenate((x, states)) for x in coordinates], _springs(linear), samples, hasty)
    left = min(each.free.at.cost for each in ways)
    if hasty and left > HOPELESS * samples:
        ended = _ended(problem, periods, [each.free for each in ways], HASTY)
        last = HASTY
    else:
        ended = _tried_again(problem, rough, periods, ways, coordinates[-1], hasty)
        last = NEAR if hasty and ended.left > EXPLAINED * samples else FINE
    minimum = ended.weighed.minimise(ended.best.x, last, LEAST_DAMPING, ended.best.at)
    spent = sum(each.free.iterations for each in ways) + ended.iterations + minimum.iterations
    return _fit(periods, ended.weighed, minimum, ended.outliers, spent)


def _tried_again(
    problem: Problem, rough: Problem, periods: Sequence[SettledPeriod], ways: Sequence["Way"], wide: Array, hasty: bool
) -> "Ended":
    """From where the best of `ways` led, with other shapes of friction near standstill too, to the ends in short steps.

    What explains the motion may still have that shape wrong, by a little of the sum: pulled motion shows it well, and
    from a narrow one there is no way to a wide one, as which `wide` (parameters' coordinates) has it.
    """
    enough = HASTY if hasty else COARSE
    way = min(ways, key=lambda each: each.free.at.cost)
    likely = ALIKE * way.free.at.cost
    shapes = [_reshaped(problem, way.free.x, way.pulled)]
    if any(name.startswith("presliding") for name in problem.coordinates.names):
        # How far friction bends before it slides is seen better than how it rises then.
        shapes.append(_reshaped(problem, way.free.x, wide, STRIBECK))
    alike = [each.free for each in ways if each.free.at.cost < likely]
    with ThreadPoolExecutor(1) as aside:
        # From a wide shape it is far: the others come to their ends meanwhile.
        coming = aside.submit(_polished, rough, _reshaped(problem, way.free.x, wide), enough, likely)
        tries = _at_once(
            [partial(rough.minimise, each.x, NEAR, at=each.at) for each in alike]
            + [partial(_polished, rough, x, enough, likely) for x in shapes]
        )
        ended = _ended(problem, periods, tries, HASTY if hasty else NEAR)
        try:
            late = coming.result()
        except ConvergenceError:
            return ended
    spent = ended.iterations + sum(found.iterations for found in (*tries, late))
    if late.at.cost < _best(tries).at.cost + CLOSE and all(abs(late.at.cost - each.at.cost) > SAME for each in tries):
        ended = _ended(problem, periods, [*tries, late], HASTY if hasty else NEAR)
        spent += ended.iterations
    return replace(ended, iterations=spent)


@dataclass(frozen=True)
class Ended:
    """Where tries lead in short steps of integration, weighed by what the best of them leaves."""

    weighed: Problem
    outliers: int
    best: Minimum
    left: float
    """Sum of squares of the best in units of the noise."""
    iterations: int


def _ended(problem: Problem, periods: Sequence[SettledPeriod], tries: Sequence[Minimum], enough: float) -> Ended:
    positions = problem.positions(_best(tries).x)
    weights, outliers = _weights(periods, positions)
    weighed = replace(problem, weights=weights)
    ends = _at_once([partial(weighed.minimise, each.x, enough) for each in _distinct(tries)])
    best = _best(ends)
    left = problem.cost(positions) * best.at.cost / weighed.cost(positions)
    return Ended(weighed, outliers, best, left, sum(found.iterations for found in ends))


@dataclass(frozen=True)
class Way:
    """How one start went, in long steps of integration."""

    pulled: Array
    """Coordinates of what fits the motion of the pulled arm."""
    free: Minimum
    """What fits the free motion, with all simulations on the way there."""


def _ways(problem: Problem, starts: Sequence[Array], springs: Array, samples: int, hasty: bool) -> list[Way]:
    """From one start after the other until the motion is explained. Raises ConvergenceError if none leads anywhere."""
    ways: list[Way] = []
    lost = ConvergenceError("no start was given")
    for x in starts:
        try:
            ways.append(_way(problem, x, springs, samples, HASTY if hasty else COARSE))
        except ConvergenceError as error:
            lost = error
            continue
        if ways[-1].free.at.cost < (HOPELESS if hasty else 1.0) * EXPLAINED * samples:
            break
    if not ways:
        raise lost
    return ways


def _springs(linear: LinearEstimate) -> Array:
    """Stiffness (joints,) [N m/rad] of springs that give each joint the frequency PULL."""
    inertia = [abs(linear.value[i]) for i, name in enumerate(linear.names) if name.startswith("inertia")]
    stiffness: Array = np.array(inertia) * (2.0 * np.pi * PULL) ** 2
    return stiffness


def _way(problem: Problem, x: Array, springs: Array, samples: int, enough: float) -> Way:
    """From stage 1's parameters to the whole free motion, by way of pulled motion."""
    pulled = replace(problem, pull=springs).minimise(x, HASTY)
    spent = pulled.iterations
    ends: list[Minimum] = []
    try:
        # Springs leave little trace of the state at the first sample.
        start = replace(problem, held=True).minimise(pulled.x, ROUGHLY)
        ends.append(problem.minimise(start.x, enough, at=start.at))
        spent += start.iterations + ends[0].iterations
    except ConvergenceError:
        pass
    if not ends or ends[0].at.cost > LOST * pulled.at.cost:
        x = pulled.x
        for share in HORIZONS:
            if share * samples > LEAST_HORIZON * x.size:
                start = replace(problem, share=share).minimise(x, HASTY)
                x, spent = start.x, spent + start.iterations
        ends.append(problem.minimise(x, enough))
        spent += ends[-1].iterations
    return Way(pulled.x, replace(_best(ends), iterations=spent))


def _at_once(fits: Sequence[Callable[[], Minimum]]) -> list[Minimum]:
    """Fits that do not need each other, in threads: what is compiled leaves the interpreter to the others.

    One that leads nowhere is no loss where there is another. Raises ConvergenceError when all do.
    """
    found: list[Minimum] = []
    lost = ConvergenceError("there was nothing to fit")
    with ThreadPoolExecutor(len(fits)) as threads:
        for running in [threads.submit(fit) for fit in fits]:
            try:
                found.append(running.result())
            except ConvergenceError as error:
                lost = error
    if not found:
        raise lost
    return found


def _best(tries: Sequence[Minimum]) -> Minimum:
    return min(tries, key=lambda found: found.at.cost)


def _distinct(tries: Sequence[Minimum]) -> list[Minimum]:
    """The best, and those that only finer steps can tell from it."""
    distinct: list[Minimum] = []
    for each in sorted(tries, key=lambda found: found.at.cost):
        cost = each.at.cost
        if not distinct or (cost > distinct[-1].at.cost + SAME and cost < distinct[0].at.cost + CLOSE):
            distinct.append(each)
    return distinct


def _shapes(linear: LinearEstimate) -> list[dict[str, float]]:
    """Friction near standstill to start from, of every joint: sharp and soft."""
    viscous, coulomb = (
        float(np.mean([abs(linear.value[i]) for i, name in enumerate(linear.names) if name.startswith(kind)]))
        for kind in ("viscous", "coulomb")
    )
    return [
        {"coulomb_width": width, "presliding_stiffness": coulomb / bend, "presliding_damping": viscous}
        for width, bend in zip(STARTING_WIDTHS, STARTING_BENDS, strict=True)
    ]


def _polished(problem: Problem, x: Array, enough: float, likely: float) -> Minimum:
    """From `x` until little is left to gain, and on if the sum of squares is below `likely`."""
    found = problem.minimise(x, enough)
    if found.at.cost >= likely:
        return found
    near = problem.minimise(found.x, NEAR, at=found.at)
    return replace(near, iterations=found.iterations + near.iterations)


def _reshaped(problem: Problem, x: Array, other: Array, kinds: tuple[str, ...] = SHAPE) -> Array:
    """The coordinates `x` with these kinds of parameters as the coordinates `other` have them."""
    shape = [kind_of(name) in kinds for name in problem.coordinates.names]
    reshaped = x.copy()
    reshaped[: len(shape)][shape] = other[: len(shape)][shape]
    return reshaped


def _problem(periods: Sequence[SettledPeriod], model: Model, linear: LinearEstimate) -> tuple[Problem, Array]:
    """The problem with every sample weighed by the noise that is known beforehand, and the states to start from."""
    velocity = float(np.sqrt(np.mean([np.mean(motion.velocity**2) for motion in linear.motions])))
    torque = float(np.sqrt(np.mean([np.mean(period.torque**2) for period in periods])))
    scales = scales_of(model.names, torque, velocity, abs(float(linear.value[0])))
    state_scale = np.repeat([ANGLE_SCALE, velocity], model.joints)
    states = [np.concatenate((m.position[:, 0], m.velocity[:, 0])) / state_scale for m in linear.motions]
    weights = tuple(np.where(period.valid, 1.0 / period.noise[:, None], 0.0) for period in periods)
    runs = tuple(_simulated(period) for period in periods)
    return Problem(runs, Coordinates(model.names, scales, WIDTH_FLOOR), state_scale, weights), np.concatenate(states)


def _simulated(period: SettledPeriod) -> Run:
    return SimulatedRun.of(period) if period.stabiliser is None else StabilisedRun.of(period, period.stabiliser)


def _start(model: Model, linear: LinearEstimate, ripple: dict[str, float], shape: Mapping[str, float]) -> Array:
    """Parameters to start from [SI] (parameters,): stage 1's, and what it does not see."""
    known = dict(zip(linear.names, linear.value.tolist(), strict=True)) | ripple
    known |= {f"{name}_{joint + 1}": value for name, value in shape.items() for joint in range(model.joints)}
    if model.drive == "delay":
        known["delay"] = linear.delay
    known |= {"lag": max(linear.delay, LEAST_LAG)}
    return np.array([known.get(name, term_of(name).initial) for name in model.names])


def _weights(periods: Sequence[SettledPeriod], positions: Sequence[Array]) -> tuple[tuple[Array, ...], int]:
    """Weights by how large each joint's errors turned out, and the number of samples far outside them."""
    weights = []
    outliers = 0
    for period, position in zip(periods, positions, strict=True):
        error = np.where(period.valid, np.abs(period.position - position), 0.0)
        # 1.35 medians are a standard deviation between those of rounding (1.15) and of normal errors (1.48).
        typical = np.array([1.35 * np.median(row[valid]) for row, valid in zip(error, period.valid, strict=True)])
        spread = np.maximum(typical, period.noise)[:, None]
        far = error > OUTLIER * spread
        weight = np.where(far, np.sqrt(OUTLIER * spread / np.where(far, error, 1.0)), 1.0)
        inside = np.where(far | ~period.valid, np.nan, error)
        rms = np.sqrt(np.nanmean(inside**2, axis=1))[:, None]
        weights.append(np.where(period.valid, weight / np.maximum(rms, period.noise[:, None]), 0.0))
        outliers += int(far.sum())
    return tuple(weights), outliers


def _fit(periods: Sequence[SettledPeriod], problem: Problem, minimum: Minimum, outliers: int, iterations: int) -> Fit:
    x = minimum.x
    positions = problem.positions(x)
    residuals = [
        weight * np.where(period.valid, period.position - position, 0.0)
        for period, position, weight in zip(periods, positions, problem.weights, strict=True)
    ]
    lags = correlation_time(residuals)
    window = max(lags, min(LONGEST_LAG, int(LEAST_WINDOW * max(period.samples for period in periods))))
    count = problem.count
    samples = int(sum(period.valid.sum() for period in periods))
    slopes = problem.coordinates.slopes(x[:count])
    structured = sum(float(np.sum(structured_share(each) * np.sum(each**2, axis=1))) for each in residuals)
    robust = robust_covariance(minimum.at, problem.scatter(x, window), samples, count, structured)
    # Weights are of the residual as it turned out; the noise that is known would give larger ones.
    known = min(float(np.median(w[w > 0.0] * p.noise.min())) for w, p in zip(problem.weights, periods, strict=True))
    white = known**2 * robust_covariance(minimum.at, None, samples, count)
    value = problem.coordinates.values(x[:count])
    return Fit(
        value,
        by_parameters(robust, slopes, value),
        by_parameters(white, slopes, value),
        tuple(problem.start(x, run) for run in range(len(periods))),
        positions,
        outliers,
        float(lags),
        iterations,
    )
