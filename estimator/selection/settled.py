"""Friction model selection: models are fitted from simple to rich and judged on a held-out motion.

A richer model always has a smaller residual on the motion it was fitted to. What it predicts of another motion, freely,
from rest, gets better only by what is true in it, or by chance: so it must also leave less of its own motion than terms
without meaning would. Without another motion the Bayesian information criterion judges (Schwarz, Annals of Statistics 6
(1978) 461), samples counted as far as the residual is not correlated.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.stats import chi2

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ConvergenceError, PeriodicityError
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify, predict
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import FRICTIONS, Drive, Option, kind_of, term_of
from hil.estimator.options import IntegrationOptions, LikelihoodOptions, MinimiserOptions, SelectionOptions
from hil.estimator.selection.candidates import Candidate, candidates, colour, ripple_cycles

DEFAULTS = SelectionOptions()
THOROUGH = LikelihoodOptions()
QUICK = LikelihoodOptions(
    minimiser=MinimiserOptions(max_iterations=25, unfinished=1.0),
    integration=IntegrationOptions(max_substeps=16),
    coarse_integration=IntegrationOptions(max_step=2.6e-3, max_substeps=8),
)
"""Bristles that turn out as stiff as none would take many substeps for nothing."""
SMOOTH: tuple[Option, ...] = ("asymmetry", "saturation", "cable", "encoder")
"""What is nothing where it is small, and so costs a fit nothing but its columns."""


@dataclass(frozen=True)
class Trial:
    """One model and its performance."""

    model: Model
    estimate: Estimate | None
    """None where the fit or the prediction found no end."""
    held_out: Array | None
    """RMS error of the free prediction over the motion's RMS (joints,)."""
    score: float
    """RMS error of the free prediction in units of the noise, or without one what the criterion puts there."""
    seconds: float


@dataclass(frozen=True)
class Choice:
    """The models tried, in order, and the chosen one."""

    trials: tuple[Trial, ...]
    chosen: Trial

    @property
    def estimate(self) -> Estimate:
        """Of the chosen model."""
        if self.chosen.estimate is None:
            raise ConvergenceError(f"{self.chosen.model.description} did not converge to full precision")
        return self.chosen.estimate

    @property
    def plainest(self) -> Trial:
        """The trial with the fewest parameters that could be fitted."""
        return min((each for each in self.trials if each.estimate is not None), key=lambda each: len(each.model.names))

    @property
    def gained(self) -> float:
        """The plainest model's error over the chosen one's."""
        return self.plainest.score / self.chosen.score

    @property
    def cost(self) -> float:
        """How much larger the base parameters' standard errors are than they would be if the terms that the plainest
        model lacks were known: what adding them cost (geometric mean)."""
        estimate = self.estimate
        std = estimate.std
        seen = np.isfinite(std) & (std > 0.0)
        added = seen & [name not in self.plainest.model.names for name in estimate.names]
        base = seen & [name in estimate.model.base_names for name in estimate.names]
        if not added.any():
            return 1.0
        correlation = np.where(np.outer(seen, seen), estimate.covariance, 0.0) / np.outer(
            np.where(seen, std, 1.0), np.where(seen, std, 1.0)
        )
        across = correlation[np.ix_(added, base)]
        told = np.sum(across * (np.linalg.pinv(correlation[np.ix_(added, added)]) @ across), axis=0)
        return float(np.exp(-0.5 * np.mean(np.log1p(-np.clip(told, 0.0, 1.0 - 1e-9)))))


def choose(
    periods: Sequence[SettledPeriod],
    held_out: SettledPeriod | None,
    drive: Drive,
    *,
    torque_scale: bool = False,
    starts: Sequence[Mapping[str, float]] = (),
    options: SelectionOptions = DEFAULTS,
) -> Choice:
    """Fit `periods` with the terms that the data support.

    Stribeck friction comes first, with the encoders' zeros and the ratio of two torque constants, which are never known
    exactly. If that does not explain the motion, or if the score test finds something in the residual
    (`hil.estimator.selection.candidates`), all else that is smooth comes at once: load, direction, saturation, cables,
    encoders that are not linear. Added one by one they mislead, since each takes over what the others lack; together,
    with what is usual of them as a prior, they are told apart. Then come friction that yields before it slides and
    ripple over the angle, and finally insignificant terms are removed. A model that predicts
    `held_out` worse than a plainer one is not chosen.

    Args:
        periods: what is fitted, settled periods of one arm; the first tells what is missing.
        held_out: a settled period of another motion, which judges; without one, the Bayesian information criterion.
        drive: the drive's terms, of every model.
        torque_scale: whether the ratio of the torque constants stays in whatever it is.
        starts: as of `hil.estimator.identify.identify`.
        options: thresholds.

    Raises:
        ConvergenceError: when no model can be fitted.
    """
    search = Selection(periods, held_out, starts, options, "torque_scale" if torque_scale else None)
    grown = search.grow(Model(periods[0].joints, "stribeck", drive))
    pruned = search.prune(grown)
    return Choice(tuple(search.trials), search.judged(pruned))


class Selection:
    """Models tried on one set of periods, each from where the one before it ended."""

    def __init__(
        self,
        periods: Sequence[SettledPeriod],
        held_out: SettledPeriod | None,
        starts: Sequence[Mapping[str, float]],
        options: SelectionOptions,
        fixed: Option | None,
    ) -> None:
        self._periods = [without_spikes(period) for period in periods]
        self._held_out = held_out
        self._starts = starts
        self._options = options
        self._fixed = fixed
        self.trials: list[Trial] = []
        """In the order in which they were made."""

    def grow(self, model: Model) -> Trial:
        """Extend `model` to the richest one that the data support. Raises ConvergenceError."""
        unknown: set[Option] = {"zeros"}
        if model.joints == 2:
            unknown |= {"torque_scale"} if model.drive == "delay" else {"torque_scale", "lags"}
        plain = self._try_or_none(model.having(*unknown), coarse=True)
        explained = plain is not None and self._is_explained(plain)
        if plain is not None and explained and not self._seen(plain):
            return plain
        smooth = replace(model, friction=FRICTIONS[-1]).having(*unknown, *SMOOTH)
        best = plain
        if plain is not None and self._left(plain) < self._options.near_residual**2:
            best = self._better(self._try_or_none(smooth, plain), plain)
        if best is None or self._left(best) > self._options.presliding_residual**2:
            best = self._better(self._try_or_none(smooth), best)
        if best is None:
            raise ConvergenceError("no friction model could be fitted: check the recording, or lower the torque")
        if self._left(best) > self._options.presliding_residual**2:
            best = self._better(self._try_or_none(smooth.having("presliding"), coarse=True), best) or best
        if not self._is_explained(best):
            best = self._with_ripple(best)
        return best if self._left(best) < self._options.presliding_residual**2 else self._reshaped(best)

    def _seen(self, trial: Trial) -> list[Candidate]:
        assert trial.estimate is not None
        return [each for each in candidates(self._periods[0], trial.estimate, {}) if each.evidence > 1.0]

    def _with_ripple(self, best: Trial) -> Trial:
        assert best.estimate is not None
        if "ripple" in best.model.options:
            return best
        known = ripple_cycles(self._periods[0], best.estimate, self._options.ripple_cycles)
        for each in candidates(self._periods[0], best.estimate, known):
            if each.part == "ripple" and each.evidence > self._options.ripple_evidence:
                return self._better(self._try_or_none(each.model, best, each.values), best) or best
        return best

    def _reshaped(self, best: Trial) -> Trial:
        """The same model from other widths of friction's step, each joint's for itself: there are local minima."""
        for joint in range(1, best.model.joints + 1):
            for width in self._options.initial_widths:
                name = f"coulomb_width_{joint}"
                if best.estimate is None or self._is_explained(best) or name not in best.estimate.names:
                    return best
                best = self._better(self._try_or_none(best.model, best, {name: width}), best) or best
        return best

    def _better(self, richer: Trial | None, plainer: Trial | None) -> Trial | None:
        """`richer` if its terms gain what they must, else `plainer`."""
        if richer is None or plainer is None:
            return richer or plainer
        if richer.model == plainer.model:
            return min(richer, plainer, key=self._left)
        return richer if self._gain(richer, plainer) > self._worth(richer, plainer) else plainer

    def prune(self, best: Trial) -> Trial:
        """Remove insignificant terms if the motion is explained as well without them."""
        assert best.estimate is not None
        if self._left(best) > self._options.presliding_residual**2:
            return best  # what is missing would be taken for what is there
        for level in self._options.prune_levels:
            plainer = self._pruned_at(level, best)
            if plainer is best or self._gain(best, plainer) < self._worth(best, plainer):
                return plainer
        return best

    def _pruned_at(self, level: float, best: Trial) -> Trial:
        """Pruned and fitted again until nothing more is doubtful: a fit of fewer terms knows the rest better."""
        while best.estimate is not None:
            plainer = _without_nothings(best.estimate, level, self._fixed)
            trial = None if plainer == best.model else self._try_or_none(plainer, best)
            if trial is None:
                break
            best = trial
        return best

    def judged(self, chosen: Trial) -> Trial:
        """`chosen`, unless another trial predicts the motion held out much better."""
        if self._held_out is None:
            return chosen
        fitted = [trial for trial in self.trials if trial.estimate is not None]
        best = min(fitted, key=lambda trial: trial.score)
        return best if best.score < self._options.overrule_ratio * chosen.score else chosen

    @property
    def _samples(self) -> int:
        return int(sum(period.valid.sum() for period in self._periods))

    def _left(self, trial: Trial) -> float:
        """Mean square of the residual, in units of the noise."""
        assert trial.estimate is not None
        return float(np.nanmean((trial.estimate.residual / self._periods[0].noise[:, None]) ** 2))

    def _is_explained(self, trial: Trial) -> bool:
        return self._left(trial) < self._options.explained_residual**2

    def _gain(self, richer: Trial, plainer: Trial) -> float:
        """Twice the gain in log-likelihood, of samples that are counted as far as they are independent."""
        assert richer.estimate is not None
        independent = self._samples / colour(richer.estimate.residual)
        return independent * float(np.log(max(self._left(plainer), 1e-12) / max(self._left(richer), 1e-12)))

    def _worth(self, richer: Trial, plainer: Trial) -> float:
        """The gain required of additional terms: the penalty of the Bayesian information criterion."""
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
        """A trial; None where the fit does not converge."""
        try:
            return self._try(model, near, values, coarse=coarse)
        except ConvergenceError:
            self.trials.append(Trial(model, None, None, np.inf, 0.0))
            return None

    def _try(self, model: Model, near: Trial | None, values: Mapping[str, float], *, coarse: bool = False) -> Trial:
        """From where `near` ended, with `values` for what it lacks, or from scratch."""
        started = time.perf_counter()
        place = None
        if near is not None and near.estimate is not None:
            place = Near({**near.estimate.parameters, **values}, near.estimate.start)
        options = QUICK if coarse and "presliding" in model.options else THOROUGH
        estimate = identify(self._periods, model, starts=self._starts, near=place, coarse=coarse, options=options)
        relative, score = self._predicted(estimate)
        trial = Trial(model, estimate, relative, score, time.perf_counter() - started)
        self.trials.append(trial)
        return trial

    def _predicted(self, estimate: Estimate) -> tuple[Array | None, float]:
        other = self._held_out
        if other is None:
            return None, _criterion(estimate, self._periods)
        try:
            predicted = predict_period(estimate, other)
        except PeriodicityError:
            return None, np.inf
        return relative_error(other, predicted), float(
            np.sqrt(np.nanmean(((other.position - predicted) / other.noise[:, None]) ** 2))
        )


def predict_period(estimate: Estimate, other: SettledPeriod) -> Array:
    """Positions (joints, samples) [rad] that `estimate` predicts of another settled period, by its torque alone.

    Raises PeriodicityError when the simulated arm does not settle.
    """
    if other.stabiliser is None:
        return predict(estimate, other.torque, other.rate, other.command_to_sample)
    pose = other.stabiliser.feedback.pose
    return other.stabiliser.settled_positions(
        Physics.of(estimate.parameters), pose, other.rate, other.command_to_sample
    )


def _without_nothings(estimate: Estimate, level: float, fixed: Option | None) -> Model:
    """The model without what is not told from nothing, the least sure taken out first.

    What a part lacks in significance is A. Wald's test (Trans. AMS 54 (1943) 426): the squared distance from zero
    in standard errors, compared with chi^2 at `level`. The remaining parameters follow from a linearised model.
    """
    return pruned_model(estimate.model, estimate.names, estimate.value, estimate.covariance, level, fixed)


def pruned_model(
    model: Model, names: Sequence[str], value: Array, covariance: Array, level: float, fixed: Option | None
) -> Model:
    """`model` without what its parameters (parameters,) and covariance do not tell from nothing at `level`; `fixed`
    stays in."""
    names, value, covariance = list(names), value.copy(), covariance.copy()
    covariance[~np.isfinite(covariance)] = 0.0
    while True:
        doubtful = []
        for part, plainer in _parts(model):
            at = [names.index(name) for name in _tested(model, plainer)]
            away = value[at] - np.array([term_of(names[i]).absent for i in at])
            own = np.linalg.pinv(covariance[np.ix_(at, at)], rcond=1e-12, hermitian=True)
            doubtful.append((float(away @ own @ away) / float(chi2.isf(level, len(at))), part, plainer, at, own, away))
        doubtful = [each for each in doubtful if each[0] < 1.0 and each[1] != fixed]
        if not doubtful:
            return model
        _, _, model, at, own, away = min(doubtful, key=lambda each: each[0])
        follow = covariance[:, at] @ own
        value = value - follow @ away
        covariance = covariance - follow @ covariance[at]


def _parts(model: Model) -> list[tuple[str, Model]]:
    """The removable terms of a model, each with the reduced model; presliding has no significance test."""
    parts: list[tuple[str, Model]] = [
        (option, model.without(option)) for option in sorted(model.options) if option != "presliding"
    ]
    law = FRICTIONS.index(model.friction)
    if law:
        parts.append((model.friction, replace(model, friction=FRICTIONS[law - 1])))
    return parts


def _tested(model: Model, plainer: Model) -> list[str]:
    """What is tested of what `plainer` lacks; where that is nothing, what it scales says nothing."""
    lacking = [name for name in model.names if name not in plainer.names]
    return [name for name in lacking if kind_of(name) not in ("ripple_cycles", "stribeck_velocity")]


def relative_error(period: SettledPeriod, predicted: Array) -> Array:
    """RMS of measured minus predicted position over the RMS of the motion about its mean (joints,)."""
    motion = period.position - np.nanmean(period.position, axis=1, keepdims=True)
    error: Array = np.sqrt(np.nanmean((period.position - predicted) ** 2, axis=1) / np.nanmean(motion**2, axis=1))
    return error


def _criterion(estimate: Estimate, periods: Sequence[SettledPeriod]) -> float:
    """exp(BIC / 2n) of the residual in units of the noise, so that it compares like an error of prediction."""
    noise = periods[0].noise
    size = np.nanmean((estimate.residual / noise[:, None]) ** 2)
    samples = sum(period.valid.sum() for period in periods) / estimate.correlation_time
    return float(np.sqrt(size) * np.exp(0.5 * len(estimate.names) * np.log(samples) / samples))
