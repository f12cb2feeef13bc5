"""Maximum-likelihood fit from several initial guesses, first with coarse integration steps.

Fine steps then decide between minima that coarse ones cannot separate. Each joint's noise level is estimated before the
final iterations, which downweight outliers (Huber) so that a few corrupted readings do no harm.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

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
    """Result of fits from one initial guess, with coarse integration steps."""

    tracking: Array
    """Coordinates of the tracking fit, in which springs hold the simulated arm close to the measured motion."""
    free: Minimum
    """Fit of the motion without springs; its iterations include those of all preceding fits."""


@dataclass(frozen=True)
class Refined:
    """The best fit with fine integration steps and samples weighted by the residual."""

    weighted: Objective
    outliers: int
    best: Minimum
    cost: float
    """Sum of squares of the best result in units of the noise."""
    iterations: int


@dataclass(frozen=True)
class Search:
    """Search for the maximum-likelihood parameters of one set of periods."""

    periods: Sequence[SettledPeriod]
    fine: Objective
    """The objective with the fine integration steps used for the result."""
    rough: Objective
    """The objective with coarse integration steps."""
    options: LikelihoodOptions
    coarse: bool
    """Whether to end fits before full convergence if the residual is well above the noise; such fits suffice to compare
    models.
    """

    @property
    def samples(self) -> int:
        """Number of valid samples over all joints and periods."""
        return int(sum(period.valid.sum() for period in self.periods))

    def minimum(self, guesses: Sequence[Array], springs: Array) -> tuple[Refined, Minimum]:
        """Return the best minimum reached from `guesses`, each (coordinates,). The last guess must have a wide Coulomb
        step.

        springs: tracking stiffness (joints,) [N m/rad]. Raises ConvergenceError.
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
        return self._undisguised(refined, replace(minimum, iterations=spent))

    def _undisguised(self, refined: Refined, minimum: Minimum) -> tuple[Refined, Minimum]:
        """Replace Stribeck friction that hardly varies with speed in this motion by Coulomb friction, unless the fit
        becomes significantly worse.
        """
        if np.array_equal(self.fine.coordinates.undisguised(minimum.x), minimum.x):
            return refined, minimum
        try:
            plain = self.nearest(minimum.x)
        except ConvergenceError:
            return refined, minimum
        worse = self.fine.cost_at(plain[1].x) - self.fine.cost_at(minimum.x)
        return plain if worse < np.log(self.samples) else (refined, minimum)

    def nearest(self, x: Array) -> tuple[Refined, Minimum]:
        """Return the minimum reached from the coordinates `x` alone. Raises ConvergenceError."""
        options = self.options
        x = self.fine.coordinates.undisguised(x)
        found = Minimum(x, self.fine.evaluate(x), 1)
        # Near a narrow friction step, the motion simulated with coarse steps is inaccurate, so a fit with them would
        # leave the minimum.
        if abs(self.rough.evaluate(x).cost / found.at.cost - 1.0) < options.same_motion:
            found = self.rough.minimise(x, options.ftol_start)
        refined = self._compare([found], options.ftol_refine)
        unexplained = refined.cost > options.explained_cost * self.samples
        ftol = options.ftol_refine if self.coarse and unexplained else options.ftol
        minimum = refined.weighted.minimise(refined.best.x, ftol, options.minimiser.min_damping, refined.best.at)
        return refined, replace(minimum, iterations=found.iterations + refined.iterations + minimum.iterations)

    def _multistart(self, guesses: Sequence[Array], springs: Array) -> list[Start]:
        """Try the guesses in turn until the motion is explained. Raises ConvergenceError if none converges."""
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
        """From a guess, fit the motion first with springs that hold it close to the measured one, then in open loop."""
        options, rough = self.options, self.rough
        ftol = options.ftol_coarse if self.coarse else options.ftol_start
        tracking = replace(rough, tracking_stiffness=springs).minimise(x, options.ftol_coarse)
        spent = tracking.iterations
        ends: list[Minimum] = []
        try:
            # With springs, the motion hardly depends on the initial state.
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
        """Using fine steps, refine the best of `starts` and variants of it with different friction near standstill.

        A fit that explains the motion may still have the wrong friction near standstill. The tracking fit determines
        this friction well, but a fit that starts from a narrow Coulomb step never reaches a wide one. Therefore both
        the friction of the tracking fit and that of `wide` (coordinates) are tried.
        """
        options = self.options
        ftol = options.ftol_coarse if self.coarse else options.ftol_start
        ftol_compare = options.ftol_coarse if self.coarse else options.ftol_refine
        start = min(starts, key=lambda each: each.free.at.cost)
        likely = options.refine_ratio * start.free.at.cost
        changed = [self._with_friction_of(start.free.x, start.tracking)]
        if any(name.startswith("presliding") for name in self.fine.coordinates.names):
            # The presliding deflection is better determined than the Stribeck rise.
            changed.append(self._with_friction_of(start.free.x, wide, STRIBECK_TERMS))
        alike = [each.free for each in starts if each.free.at.cost < likely]
        with ThreadPoolExecutor(1) as aside:
            # The fit from a wide step takes long, so the others run meanwhile.
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
        """Fit from `x` with tolerance `ftol`, and then more precisely if the sum of squares is below `likely`."""
        found = self.rough.minimise(x, ftol)
        if found.at.cost >= likely:
            return found
        near = self.rough.minimise(found.x, self.options.ftol_refine, at=found.at)
        return replace(near, iterations=found.iterations + near.iterations)

    def _compare(self, tries: Sequence[Minimum], ftol: float) -> Refined:
        """Refit `tries` with fine steps, weighting samples by the residual of the best of them; return the best fit."""
        positions = self.fine.positions(_best(tries).x)
        weights, outliers = noise_weights(self.periods, positions, self.options.outlier_threshold)
        weighted = replace(self.fine, weights=weights)
        ends = self._at_once([partial(weighted.minimise, each.x, ftol) for each in self._distinct(tries)])
        best = _best(ends)
        cost = self.fine.cost(positions) * best.at.cost / weighted.cost(positions)
        return Refined(weighted, outliers, best, cost, sum(found.iterations for found in ends))

    def _distinct(self, tries: Sequence[Minimum]) -> list[Minimum]:
        """Return the best minimum and those that only finer steps can distinguish from it."""
        distinct: list[Minimum] = []
        for each in sorted(tries, key=lambda found: found.at.cost):
            cost = each.at.cost
            other = not distinct or cost > distinct[-1].at.cost + self.options.same_cost
            if other and (not distinct or cost < distinct[0].at.cost + self.options.close_cost):
                distinct.append(each)
        return distinct

    def _with_friction_of(self, x: Array, other: Array, kinds: tuple[str, ...] = STANDSTILL_TERMS) -> Array:
        """Return the coordinates `x`, with parameters of these `kinds` taken from the coordinates `other`."""
        chosen = [kind_of(name) in kinds for name in self.fine.coordinates.names]
        changed = x.copy()
        changed[: len(chosen)][chosen] = other[: len(chosen)][chosen]
        return changed

    def _at_once(self, fits: Sequence[Callable[[], Minimum]]) -> list[Minimum]:
        """Run independent fits in threads; compiled code releases the GIL.

        Fits that do not converge are ignored if at least one fit converges; otherwise, ConvergenceError is raised.
        """
        found: list[Minimum] = []
        lost = ConvergenceError("no fit was started")
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
