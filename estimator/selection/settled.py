"""Friction model selection: fits models from simple to rich and evaluates them on a held-out motion.

If a richer model predicts another motion better in open loop, either its additional terms are real, or the improvement
is due to chance. Therefore it must also reduce the residual by more than meaningless terms would. Without another
motion, the Bayesian information criterion is used (Schwarz, Annals of Statistics 6 (1978) 461), with the number of
samples reduced according to the residual's correlation.
"""

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from itertools import islice
from types import MappingProxyType

import numpy as np

from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.ripple import WAVES
from hil.estimator.models.model import Model
from hil.estimator.models.terms import FRICTIONS, Drive, Option
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.candidates import SMOOTH, Candidate, candidates, colour
from hil.estimator.selection.drift import Drift, friction_change
from hil.estimator.selection.pruning import removable_parts, without_nothings
from hil.estimator.selection.restarts import bristles, left_over, restarts, undisguised
from hil.estimator.selection.steadied import steadied
from hil.estimator.selection.trial import Choice, Fitting, Trial
from hil.estimator.selection.waves import ranked_cycles, wave_peaks

DEFAULTS = SelectionOptions()


def choose(
    periods: Sequence[SettledPeriod],
    held_out: SettledPeriod | None,
    drive: Drive,
    *,
    torque_scale: bool = False,
    by_voltage: Collection[int] = (),
    lever: float | None = None,
    starts: Sequence[Mapping[str, float]] = (),
    seconds: float | None = None,
    options: SelectionOptions = DEFAULTS,
    executor: Executor | None = None,
) -> Choice:
    """Fit `periods` with the terms that the data support.

    First, Stribeck friction is fitted together with the encoders' zeros and the ratio of two torque constants, which
    are never known exactly. If that does not explain the motion, or if a score test finds a significant term in the
    residual (`hil.estimator.selection.candidates`), all other smooth terms are added at once: load, direction,
    saturation, cables, encoder nonlinearity. Added one by one, each would absorb the effects of those still missing;
    added together, with typical sizes as a prior, they can be separated. Then presliding friction and torque ripple are
    tried, and finally insignificant terms are removed. A model that predicts `held_out` worse than a simpler one is not
    chosen. If friction differs between `periods` and `held_out`, it has also changed within each; this change is
    corrected (`hil.estimator.selection.steadied`).

    Args:
        periods: settled periods of one arm to be fitted; the first is used to find missing terms.
        held_out: a settled period of another motion, for validation; without one, the Bayesian information criterion is
            used.
        drive: drive model of all candidates.
        torque_scale: whether the ratio of the torque constants is always kept.
        by_voltage: joints (from 1) that are driven by voltage.
        lever: as for `hil.estimator.models.model.Model`.
        starts: additional initial guesses as in `hil.estimator.identify.identify`.
        seconds: time from the middle of `periods` to that of `held_out` [s], if known.
        options: thresholds.
        executor: a concurrent.futures executor on which fits that may not be needed are started early. It does not
            affect the choice.

    Raises:
        ConvergenceError: if no model can be fitted.
    """
    fixed: Option | None = "torque_scale" if torque_scale else None
    search = Selection(periods, held_out, starts, options, fixed, executor, seconds)
    try:
        grown = search.grow(Model(periods[0].joints, "stribeck", drive, by_voltage=by_voltage, lever=lever))
        pruned = search.prune(grown)
    finally:
        search.end()
    return Choice(tuple(search.trials), search.judged(pruned), search.period, search.drift)


class Selection:
    """Models tried on one set of periods, each starting from the result of the previous one."""

    def __init__(
        self,
        periods: Sequence[SettledPeriod],
        held_out: SettledPeriod | None,
        starts: Sequence[Mapping[str, float]],
        options: SelectionOptions,
        fixed: Option | None,
        executor: Executor | None = None,
        seconds: float | None = None,
    ) -> None:
        self._periods = [without_spikes(period) for period in periods]
        self._held_out = held_out
        self._raw = self._periods, held_out
        self._fitting = Fitting(self._periods, held_out, starts)
        self._options = options
        self._fixed = fixed
        self._executor = executor
        self._seconds = seconds
        self._begun: dict[tuple[Model, int, bool], Future[Trial]] = {}
        self.trials: list[Trial] = []
        """All trials with the current correction of the periods, in chronological order."""

    @property
    def period(self) -> SettledPeriod:
        """The first period as fitted, including any correction."""
        return self._periods[0]

    @property
    def drift(self) -> Drift | None:
        """The change in friction for which the periods are corrected."""
        return self._fitting.drift

    def _begin(self, model: Model, near: Trial | None = None, *, coarse: bool = False) -> None:
        """If there is an executor, start a fit in advance; it becomes a trial only when needed."""
        key = (model, id(near), coarse)
        if self._executor is not None and key not in self._begun:
            self._begun[key] = self._executor.submit(self._fitting.trial, model, near, {}, coarse)

    def end(self) -> None:
        """Cancel fits that were started but not needed."""
        for future in self._begun.values():
            future.cancel()

    def grow(self, model: Model) -> Trial:
        """Extend `model` to the richest one that the data support; raises ConvergenceError."""
        unknown: set[Option] = {"zeros"}
        if model.joints == 2:
            unknown |= {"torque_scale", "lags"}
        smooth = replace(model, friction=FRICTIONS[-1]).having(*unknown, *SMOOTH)
        self._begin(model.having(*unknown), coarse=True)
        self._begin(smooth, coarse=True)
        self._begin(smooth.having("presliding"), coarse=True)
        plain = self._try_or_none(model.having(*unknown), coarse=True)
        explained = plain is not None and self._is_explained(plain)
        if plain is not None and explained and not self._seen(plain):
            return self._undisguised(self._steadied(plain) or plain)
        best = plain
        if plain is not None and self._left(plain) < self._options.near_residual**2:
            best = self._steadied(self._better(self._try_or_none(smooth, plain, coarse=True), plain))
        if best is None or self._left(best) > self._options.presliding_residual**2:
            best = self._better(self._try_or_none(smooth, coarse=True), best)
        if best is None:
            raise ConvergenceError("no friction model could be fitted: check the recording, or lower the torque")
        if self._left(best) > self._options.presliding_residual**2:
            best = self._better(self._try_or_none(smooth.having("presliding"), coarse=True), best) or best
        for near in self._closest():
            if not self._is_explained(best):
                best = self._better(self._with_wave(near, plain), best) or best
        if set(WAVES) & set(best.model.options) and not self._is_explained(best):
            best = self._with_wave(best)
        best = self._steadied(best) or best
        again = self._with_bristles(self._restarted(best))
        again = self._converged(best if again is best else self._steadied(again) or again)
        return self._undisguised(self._without_bristles(again))

    def _undisguised(self, best: Trial) -> Trial:
        """Refit with narrow Coulomb steps where these could cause the apparent Stribeck rise; keep the better fit."""
        values = {} if best.estimate is None else undisguised(best.estimate)
        return self._better(self._try_or_none(best.model, best, values), best) or best if values else best

    def _without_bristles(self, best: Trial) -> Trial:
        """Drop presliding, which may have imitated ripple, if the motion is explained equally well without it."""
        if "presliding" not in best.model.options or not set(WAVES) & set(best.model.options):
            return best
        return self._better(best, self._try_or_none(best.model.without("presliding"), best)) or best

    def _with_bristles(self, best: Trial) -> Trial:
        """Add presliding to a model that explains nearly everything; the fit starts from its minimum, without a wider
        search.
        """
        if best.estimate is None or "presliding" in best.model.options:
            return best
        richer = best.model.having("presliding")
        for bend in self._options.initial_bends:
            if self._is_explained(best):
                break
            values = {name: value for each in bristles(best.estimate, bend) for name, value in each.items()}
            best = self._better(self._try_or_none(richer, best, values, coarse=True), best) or best
        return best

    def _closest(self) -> list[Trial]:
        """Return the trials that explain the motion best, one with and one without presliding, best first.

        Ripple is most visible in the fit that explains the most, even if some of its terms are not significant, but
        bristles may have absorbed part of the ripple.
        """
        fitted = sorted((each for each in self.trials if each.estimate is not None), key=self._left)
        fitted = [each for each in fitted if each.has_standard_errors] or fitted
        kinds = {"presliding" in each.model.options: each for each in reversed(fitted)}
        return sorted(kinds.values(), key=self._left)

    def _steadied(self, trial: Trial | None) -> Trial | None:
        """Correct the periods for a change in friction, if one is found and the motion is then explained equally well.

        The change is estimated from the uncorrected recordings, so that a later call, with a better model, replaces or
        withdraws an earlier correction. Returns the fit of the corrected periods, or else `trial`.
        """
        periods, other = self._raw
        if trial is None or trial.estimate is None or other is None or self._seconds is None or len(periods) > 1:
            return trial
        if self.drift is None and self._left(trial) > self._options.steady_residual**2:
            return trial
        drift = friction_change(other, trial.estimate, self._seconds)
        former = self._periods, self._fitting, self.trials
        if drift.is_seen:
            later = drift.at_the_later(trial.estimate)
            corrected = [steadied(periods[0], trial.estimate, drift)], steadied(other, later, drift)
            self._use(*corrected, drift)
        elif self.drift is None:
            return trial
        else:
            self._use(periods, other, None)
        again = self._try_or_none(trial.model, trial)
        if again is not None:
            # If other terms have mimicked the change, the residual need not decrease: they are removed by pruning.
            as_good = self._is_explained(again) or self._left(again) < self._left(trial)
            if self.drift is None or as_good:
                return again
        self._periods, self._fitting, self.trials = former
        return trial

    def _use(self, periods: Sequence[SettledPeriod], held_out: SettledPeriod | None, drift: Drift | None) -> None:
        """Fit these periods from now on; discard the trials and pending fits of the previous periods."""
        self._periods = list(periods)
        self._fitting = replace(self._fitting, periods=self._periods, held_out=held_out, drift=drift)
        self.trials = []
        self.end()
        self._begun.clear()

    def _seen(self, trial: Trial) -> list[Candidate]:
        assert trial.estimate is not None
        return [each for each in candidates(self._periods[0], trial.estimate, {}) if each.evidence > 1.0]

    def _with_wave(self, best: Trial, plain: Trial | None = None) -> Trial:
        """Add ripple or cogging, whichever explains more, if the score test finds it.

        The score test needs the model that explains the most, `best`. In that model, other terms imitate the wave.
        Therefore the wave is first added to `plain`, which has few such terms, and then the other terms are added.
        """
        assert best.estimate is not None
        absent = [wave for wave in WAVES if wave not in best.model.options]
        if not absent:
            return best
        peaks = wave_peaks(self._periods[0], best.estimate, self._options.wave_cycles, absent)
        found = best
        for rank, known in enumerate(ranked_cycles(peaks, self._options.max_wave_peaks)):
            seen = candidates(self._periods[0], best.estimate, known)
            least = 1.0 if rank else self._options.wave_evidence
            wave = next((each for each in seen if each.part in absent and each.evidence > least), None)
            if wave is None:
                continue
            simple = self._waving(plain, wave)
            if simple is not None and self._is_explained(simple) and not self._seen(simple):
                return simple
            near, values = (best, wave.values) if simple is None else (simple, {})
            found = self._better(simple, found) or found
            found = self._better(self._try_or_none(wave.model, near, values, coarse=True), found) or found
            if self._is_nearly_explained(found):
                break
        return found

    def _waving(self, plain: Trial | None, wave: Candidate) -> Trial | None:
        """Return `plain` with the wave and, if needed, encoder errors; None unless this explains nearly everything."""
        if plain is None or wave.evidence < 1.0:
            return None
        named = {name: value if "cycles" in name else 0.0 for name, value in wave.values.items()}
        waving = plain.model.having(*(each for each in WAVES if each == wave.part))
        simple = self._try_or_none(waving, plain, named, coarse=True)
        if simple is not None and self._is_nearly_explained(simple):
            if not self._is_explained(simple):
                simple = self._better(self._try_or_none(waving.having("encoder"), simple, coarse=True), simple)
        else:
            simple = self._try_or_none(waving.having("encoder"), plain, named, coarse=True)
        return simple if simple is not None and self._is_nearly_explained(simple) else None

    def _is_nearly_explained(self, trial: Trial) -> bool:
        return self._left(trial) < self._options.presliding_residual**2

    def _converged(self, trial: Trial) -> Trial:
        """Refit, to full precision, a trial that ended early because much of the motion remained unexplained."""
        if not trial.coarse or self._is_explained(trial):
            return trial
        return self._try_or_none(trial.model, trial) or trial

    def _restarted(self, best: Trial) -> Trial:
        """Refit the model from other initial guesses until every joint's motion is explained or no guess remains."""
        left, improved = self._options.max_restarts, True
        while improved and best.estimate is not None:
            improved = False
            for values in islice(restarts(self.period, best.estimate, self._options), left):
                left -= 1
                again = self._better(self._try_or_none(best.model, best, values, coarse=True), best)
                if again is not None and again is not best:
                    best, improved = again, True
                    break
        return best

    def _better(self, richer: Trial | None, plainer: Trial | None) -> Trial | None:
        """Return the trial to continue from. One without standard errors is too sensitive for any score test, so it is
        returned only if it explains nearly everything and the other one does not.
        """
        if richer is None or plainer is None:
            return richer or plainer
        if richer.has_standard_errors != plainer.has_standard_errors:
            sure, unsure = (richer, plainer) if richer.has_standard_errors else (plainer, richer)
            return unsure if self._is_nearly_explained(unsure) and not self._is_nearly_explained(sure) else sure
        if richer.model == plainer.model:
            return min(richer, plainer, key=self._left)
        return richer if self._gain(richer, plainer) > self._worth(richer, plainer) else plainer

    def prune(self, best: Trial) -> Trial:
        """Remove insignificant terms if the motion is explained equally well without them."""
        assert best.estimate is not None
        if self._left(best) > self._options.presliding_residual**2:
            return best  # effects of missing terms would be attributed to those present
        if not best.has_standard_errors:
            return self._pruned_by_fits(best)
        for level in self._options.prune_levels:
            plainest = without_nothings(best.estimate, level, self._fixed)
            if plainest != best.model:
                self._begin(plainest, best)
        for level in self._options.prune_levels:
            plainer = self._pruned_at(level, best)
            if plainer is best or self._gain(best, plainer) < self._worth(best, plainer):
                return plainer
        return best

    def _pruned_at(self, level: float, best: Trial) -> Trial:
        """Prune and refit until no term is insignificant; with fewer terms, the remaining ones become more certain."""
        while best.estimate is not None:
            plainer = without_nothings(best.estimate, level, self._fixed)
            trial = None if plainer == best.model else self._try_or_none(plainer, best)
            if trial is None:
                break
            best = trial
        return best

    def _pruned_by_fits(self, best: Trial) -> Trial:
        """Remove terms one by one, testing each by a fit without it, if the motion is too sensitive for a test based on
        standard errors.
        """
        for part, plainer in removable_parts(best.model):
            trial = None if part == self._fixed else self._try_or_none(plainer, best)
            if trial is not None and self._gain(best, trial) < self._worth(best, trial):
                return self._pruned_by_fits(trial)
        return best

    def judged(self, chosen: Trial) -> Trial:
        """Return `chosen`, unless it has no standard errors or another trial predicts the held-out motion much better.

        An estimate has no standard errors if the motion is too sensitive to a term, such as extremely stiff bristles.
        """
        certain = [trial for trial in self.trials if trial.has_standard_errors]
        if not certain:
            return chosen
        best = min(certain, key=lambda trial: trial.score)
        if not chosen.has_standard_errors:
            return best
        if self._held_out is None:
            return chosen
        return best if best.score < self._options.overrule_ratio * chosen.score else chosen

    @property
    def _samples(self) -> int:
        return int(sum(period.valid.sum() for period in self._periods))

    def _left(self, trial: Trial) -> float:
        """Return the mean square of the residual, in units of the noise."""
        assert trial.estimate is not None
        return left_over(self._periods[0], trial.estimate)

    def _is_explained(self, trial: Trial) -> bool:
        return self._left(trial) < self._options.explained_residual**2

    def _gain(self, richer: Trial, plainer: Trial) -> float:
        """Return twice the gain in log-likelihood, with the number of samples reduced to allow for correlation."""
        assert richer.estimate is not None
        independent = self._samples / colour(richer.estimate.residual)
        return independent * float(np.log(max(self._left(plainer), 1e-12) / max(self._left(richer), 1e-12)))

    def _worth(self, richer: Trial, plainer: Trial) -> float:
        """Return the gain required of additional terms: the penalty of the Bayesian information criterion."""
        assert richer.estimate is not None
        independent = max(self._samples / colour(richer.estimate.residual), 3.0)
        return max(1, len(richer.model.names) - len(plainer.model.names)) * float(np.log(independent))

    def _try_or_none(
        self,
        model: Model,
        near: Trial | None = None,
        values: Mapping[str, float] = MappingProxyType({}),
        *,
        coarse: bool = False,
    ) -> Trial | None:
        try:
            return self._try(model, near, values, coarse=coarse)
        except ConvergenceError:
            self.trials.append(Trial(model, None, None, np.inf, 0.0))
            return None

    def _try(self, model: Model, near: Trial | None, values: Mapping[str, float], *, coarse: bool = False) -> Trial:
        """Fit from scratch or from the result of `near`, in which `values` replace or add parameters."""
        begun = None if values else self._begun.pop((model, id(near), coarse), None)
        trial = self._fitting.trial(model, near, values, coarse) if begun is None else begun.result()
        self.trials.append(trial)
        return trial
