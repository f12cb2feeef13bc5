"""Which friction model: fitted one after the other, from plain to rich, and judged by a motion none of them saw.

A richer model always leaves less of the motion it was fitted to. What it predicts of another motion, freely, from
rest, gets better only by what is true in it, or by chance: so it must also leave less of its own motion than terms
without meaning would. Without another motion the Bayesian information criterion judges (Schwarz, Annals of Statistics 6
(1978) 461), samples counted as far as the residual is not correlated.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError, PeriodicityError
from hil.estimator.identify import Estimate, identify, predict
from hil.estimator.models.model import Model
from hil.estimator.models.terms import Drive
from hil.estimator.options import SelectionOptions

DEFAULTS = SelectionOptions()


@dataclass(frozen=True)
class Trial:
    """One model and how it did."""

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
    """The models tried, in order, and the one chosen."""

    trials: tuple[Trial, ...]
    chosen: Trial

    @property
    def estimate(self) -> Estimate:
        """Of the chosen model."""
        if self.chosen.estimate is None:
            raise ConvergenceError(f"{self.chosen.model.description} could not be fitted to its last digits")
        return self.chosen.estimate

    @property
    def gained(self) -> float:
        """The plainest model's error over the chosen one's."""
        return self.trials[0].score / self.chosen.score

    @property
    def cost(self) -> float:
        """How much larger the base parameters' standard errors are than they would be if the terms that the plainest
        model lacks were known: what adding them cost (geometric mean)."""
        estimate = self.estimate
        std = estimate.std
        seen = np.isfinite(std)
        added = seen & [name not in self.trials[0].model.names for name in estimate.names]
        base = seen & [name in estimate.model.base_names for name in estimate.names]
        correlation = np.where(np.outer(seen, seen), estimate.covariance, 0.0) / np.outer(std, std)
        across = correlation[np.ix_(added, base)]
        told = np.sum(across * np.linalg.solve(correlation[np.ix_(added, added)], across), axis=0)
        return float(np.exp(-0.5 * np.mean(np.log1p(-told))))


def choose(
    periods: Sequence[SettledPeriod],
    held_out: SettledPeriod | None,
    drive: Drive,
    *,
    torque_scale: bool = False,
    starts: Sequence[Mapping[str, float]] = (),
    options: SelectionOptions = DEFAULTS,
) -> Choice:
    """Fit `periods` with richer and richer friction as long as it predicts `held_out` better.

    Coulomb, Stribeck and load-dependent friction come first; then ripple over the angle, friction that yields before it
    slides and friction that differs with direction, on top of the best. Ends when the prediction's error is the
    encoder's own noise. Raises ConvergenceError when no model can be fitted. `torque_scale` is part of every
    model, or of none; `starts` as of `hil.estimator.identify.identify`.
    """
    trials: list[Trial] = []
    best: Trial | None = None
    tried = partial(_try, periods, held_out, starts)
    joints = periods[0].joints
    for step in _ladder(joints, drive):
        model = step.having("torque_scale") if torque_scale else step
        trial = tried(model if best is None else _on_top(model, best.model), coarse=True)
        trials.append(trial)
        if best is None or (
            trial.score < options.keep_ratio * best.score and _beyond_chance(trial.estimate, best.estimate)
        ):
            best = trial
        if best.score < options.explained_error:
            break
    if best is None or best.estimate is None:
        raise ConvergenceError("no friction model could be fitted: look at the recording, or lower the torque")
    if best.score >= options.explained_error:
        best = tried(best.model, coarse=False)
    return Choice(tuple(trials), best)


def _ladder(joints: int, drive: Drive) -> Iterator[Model]:
    yield Model(joints, "coulomb", drive)
    yield Model(joints, "stribeck", drive)
    yield Model(joints, "stribeck_load", drive)
    yield Model(joints, "stribeck_load", drive, {"ripple"})
    yield Model(joints, "stribeck_load", drive, {"presliding"})
    yield Model(joints, "coulomb", drive, {"asymmetry"})


def _on_top(model: Model, best: Model) -> Model:
    """Direction is added to the best so far; presliding and ripple only show with all of friction in place."""
    if "asymmetry" in model.options:
        return best.having("asymmetry")
    return model.having("ripple") if "ripple" in best.options else model


def _beyond_chance(richer: Estimate | None, plainer: Estimate | None) -> bool:
    """Whether more terms explain the motion that they were fitted to better than terms without meaning do.

    A flat minimum leaves much to chance in what it predicts of another motion. By Akaike's criterion (IEEE Trans.
    Automatic Control 19 (1974) 716): twice the gain in log-likelihood above twice the number of terms.
    """
    if richer is None or plainer is None:
        return richer is not None
    samples = np.sum(np.isfinite(richer.residual), axis=1)
    gain = 2.0 * float(np.sum(samples * np.log(plainer.residual_steps / richer.residual_steps)))
    return gain > 2.0 * (len(richer.names) - len(plainer.names))


def _try(
    periods: Sequence[SettledPeriod],
    held_out: SettledPeriod | None,
    starts: Sequence[Mapping[str, float]],
    model: Model,
    *,
    coarse: bool,
) -> Trial:
    started = time.perf_counter()
    relative = None
    try:
        estimate = identify(periods, model, coarse=coarse, starts=starts)
        if held_out is None:
            score = _criterion(estimate, periods)
        else:
            predicted = predict(estimate, held_out.torque, held_out.rate, held_out.command_to_sample)
            relative = relative_error(held_out, predicted)
            score = float(np.sqrt(np.nanmean(((held_out.position - predicted) / held_out.noise[:, None]) ** 2)))
    except (ConvergenceError, PeriodicityError):
        return Trial(model, None, None, np.inf, time.perf_counter() - started)
    return Trial(model, estimate, relative, score, time.perf_counter() - started)


def relative_error(period: SettledPeriod, predicted: Array) -> Array:
    """RMS of measured less predicted position over the RMS of the motion about its mean (joints,)."""
    motion = period.position - np.nanmean(period.position, axis=1, keepdims=True)
    error: Array = np.sqrt(np.nanmean((period.position - predicted) ** 2, axis=1) / np.nanmean(motion**2, axis=1))
    return error


def _criterion(estimate: Estimate, periods: Sequence[SettledPeriod]) -> float:
    """exp(BIC / 2n) of the residual in units of the noise, so that it compares like an error of prediction."""
    noise = periods[0].noise
    size = np.nanmean((estimate.residual / noise[:, None]) ** 2)
    samples = sum(period.valid.sum() for period in periods) / estimate.correlation_time
    return float(np.sqrt(size) * np.exp(0.5 * len(estimate.names) * np.log(samples) / samples))
