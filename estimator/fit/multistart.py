"""Minimisation of the likelihood from several initial guesses, with coarse integration steps first.

Most iterations use coarse integration steps; fine steps decide between minima that the coarse ones cannot separate.
The noise level of each joint is itself estimated before the final iterations, in which outliers are
downweighted (Huber), so that a few wild readings do no harm.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.levenberg_marquardt import Minimum
from hil.estimator.fit.noise_weights import noise_weights
from hil.estimator.fit.objective import Objective
from hil.estimator.models.terms import TERMS, kind_of
from hil.estimator.options import LikelihoodOptions
from hil.estimator.threads import thread_count

STANDSTILL_TERMS = tuple(name for name, term in TERMS.items() if term.standstill)
STRIBECK_TERMS = tuple(name for name, term in TERMS.items() if term.part == "stribeck")


@dataclass(frozen=True)
class Start:
    """Result from one initial guess with coarse integration steps."""

    tracking: Array
    """Coordinates of what fits the motion of the arm that springs hold to the measured one."""
    free: Minimum
    """What fits the free motion, counting all simulations on the way there."""


@dataclass(frozen=True)
class Refined:
    """Results with fine integration steps, weighted by the residual of the best."""

    weighted: Objective
    outliers: int
    best: Minimum
    cost: float
    """Sum of squares of the best in units of the noise."""
    iterations: int


@dataclass(frozen=True)
class Search:
    """The search on one set of periods."""

    periods: Sequence[SettledPeriod]
    fine: Objective
    """With the integration steps of the result."""
    rough: Objective
    """With coarse integration steps."""
    options: LikelihoodOptions
    coarse: bool
    """Whether a model is only tried: what leaves much more than the noise is given up before its last digits."""

    @property
    def samples(self) -> int:
        """Valid samples of all joints and periods."""
        return int(sum(period.valid.sum() for period in self.periods))

    def minimum(self, guesses: Sequence[Array], springs: Array) -> tuple[Refined, Minimum]:
        """The best minimum from `guesses` (each: coordinates), the last of which has wide friction near standstill.

        `springs`: tracking stiffness (joints,) [N m/rad]. Raises ConvergenceError.
        """
        options = self.options
        starts = self._multistart(guesses, springs)
        if self.coarse and min(each.free.at.cost for each in starts) > options.hopeless_cost * self.samples:
            refined = self._compare([each.free for each in starts], options.ftol_coarse)
            ftol = options.ftol_coarse
        else:
            refined = self._refine(starts, guesses[-1])
            unexplained = refined.cost > options.explained_cost * self.samples
            ftol = options.ftol_refine if self.coarse and unexplained else options.ftol
        best = refined.best
        minimum = refined.weighted.minimise(best.x, ftol, options.minimiser.min_damping, best.at)
        spent = sum(each.free.iterations for each in starts) + refined.iterations + minimum.iterations
        return refined, replace(minimum, iterations=spent)

    def nearest(self, x: Array) -> tuple[Refined, Minimum]:
        """The minimum to which the coordinates `x` lead, and no other. Raises ConvergenceError."""
        options = self.options
        found = self.rough.minimise(x, options.ftol_start)
        refined = self._compare([found], options.ftol_refine)
        unexplained = refined.cost > options.explained_cost * self.samples
        ftol = options.ftol_refine if self.coarse and unexplained else options.ftol
        minimum = refined.weighted.minimise(refined.best.x, ftol, options.minimiser.min_damping, refined.best.at)
        return refined, replace(minimum, iterations=found.iterations + refined.iterations + minimum.iterations)

    def _multistart(self, guesses: Sequence[Array], springs: Array) -> list[Start]:
        """Try one guess after the other until the motion is explained. Raises ConvergenceError if none converges."""
        starts: list[Start] = []
        lost = ConvergenceError("no initial guess was given")
        enough = (self.options.hopeless_cost if self.coarse else 1.0) * self.options.explained_cost * self.samples
        for x in guesses:
            try:
                starts.append(self._from_guess(x, springs))
            except ConvergenceError as error:
                lost = error
                continue
            if starts[-1].free.at.cost < enough:
                break
        if not starts:
            raise lost
        return starts

    def _from_guess(self, x: Array, springs: Array) -> Start:
        """From a guess to the open-loop motion, by way of motion that springs keep close to the measured one."""
        options, rough = self.options, self.rough
        ftol = options.ftol_coarse if self.coarse else options.ftol_start
        tracking = replace(rough, tracking_stiffness=springs).minimise(x, options.ftol_coarse)
        spent = tracking.iterations
        ends: list[Minimum] = []
        try:
            # Springs leave little trace of the state at the first sample.
            start = replace(rough, fixed_parameters=True).minimise(tracking.x, options.ftol_state)
            ends.append(rough.minimise(start.x, ftol, at=start.at))
            spent += start.iterations + ends[0].iterations
        except ConvergenceError:
            pass
        if not ends or ends[0].at.cost > options.tracking_loss * tracking.at.cost:
            x = tracking.x
            for horizon in options.horizons:
                if horizon * self.samples > options.min_horizon_samples * x.size:
                    start = replace(rough, horizon=horizon).minimise(x, options.ftol_coarse)
                    x, spent = start.x, spent + start.iterations
            ends.append(rough.minimise(x, ftol))
            spent += ends[-1].iterations
        return Start(tracking.x, replace(_best(ends), iterations=spent))

    def _refine(self, starts: Sequence[Start], wide: Array) -> Refined:
        """From where the best of `starts` led, with other friction near standstill too, to minima in fine steps.

        What explains the motion may still have that friction wrong, by a little of the sum: the tracking fit shows it
        well, and from a narrow step there is no path to a wide one, as which `wide` (coordinates) has it.
        """
        options = self.options
        ftol = options.ftol_coarse if self.coarse else options.ftol_start
        ftol_compare = options.ftol_coarse if self.coarse else options.ftol_refine
        start = min(starts, key=lambda each: each.free.at.cost)
        likely = options.refine_ratio * start.free.at.cost
        changed = [self._with_friction_of(start.free.x, start.tracking)]
        if any(name.startswith("presliding") for name in self.fine.coordinates.names):
            # How far friction bends before it slides is seen better than how it rises then.
            changed.append(self._with_friction_of(start.free.x, wide, STRIBECK_TERMS))
        alike = [each.free for each in starts if each.free.at.cost < likely]
        with ThreadPoolExecutor(1) as aside:
            # From a wide step it is far: the others converge meanwhile.
            coming = aside.submit(self._polish, self._with_friction_of(start.free.x, wide), ftol, likely)
            tries = self._at_once(
                [partial(self.rough.minimise, each.x, options.ftol_refine, at=each.at) for each in alike]
                + [partial(self._polish, x, ftol, likely) for x in changed]
            )
            refined = self._compare(tries, ftol_compare)
            try:
                late = coming.result()
            except ConvergenceError:
                return refined
        spent = refined.iterations + sum(found.iterations for found in (*tries, late))
        near = late.at.cost < _best(tries).at.cost + options.close_cost
        if near and all(abs(late.at.cost - each.at.cost) > options.same_cost for each in tries):
            refined = self._compare([*tries, late], ftol_compare)
            spent += refined.iterations
        return replace(refined, iterations=spent)

    def _polish(self, x: Array, ftol: float, likely: float) -> Minimum:
        """From `x` until little is left to gain, and on if the sum of squares is below `likely`."""
        found = self.rough.minimise(x, ftol)
        if found.at.cost >= likely:
            return found
        near = self.rough.minimise(found.x, self.options.ftol_refine, at=found.at)
        return replace(near, iterations=found.iterations + near.iterations)

    def _compare(self, tries: Sequence[Minimum], ftol: float) -> Refined:
        """The best of `tries` in fine steps, samples weighted by what the best of them leaves."""
        positions = self.fine.positions(_best(tries).x)
        weights, outliers = noise_weights(self.periods, positions, self.options.outlier_threshold)
        weighted = replace(self.fine, weights=weights)
        ends = self._at_once([partial(weighted.minimise, each.x, ftol) for each in self._distinct(tries)])
        best = _best(ends)
        cost = self.fine.cost(positions) * best.at.cost / weighted.cost(positions)
        return Refined(weighted, outliers, best, cost, sum(found.iterations for found in ends))

    def _distinct(self, tries: Sequence[Minimum]) -> list[Minimum]:
        """The best, and those that only finer steps can distinguish from it."""
        distinct: list[Minimum] = []
        for each in sorted(tries, key=lambda found: found.at.cost):
            cost = each.at.cost
            other = not distinct or cost > distinct[-1].at.cost + self.options.same_cost
            if other and (not distinct or cost < distinct[0].at.cost + self.options.close_cost):
                distinct.append(each)
        return distinct

    def _with_friction_of(self, x: Array, other: Array, kinds: tuple[str, ...] = STANDSTILL_TERMS) -> Array:
        """The coordinates `x` with these kinds of parameters as the coordinates `other` have them."""
        chosen = [kind_of(name) in kinds for name in self.fine.coordinates.names]
        changed = x.copy()
        changed[: len(chosen)][chosen] = other[: len(chosen)][chosen]
        return changed

    def _at_once(self, fits: Sequence[Callable[[], Minimum]]) -> list[Minimum]:
        """Fits that do not need each other, in threads: what is compiled leaves the interpreter to the others.

        One that does not converge is no loss where there is another. Raises ConvergenceError when none does.
        """
        found: list[Minimum] = []
        lost = ConvergenceError("there was nothing to fit")
        with ThreadPoolExecutor(min(len(fits), thread_count(self.options.threads))) as threads:
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
