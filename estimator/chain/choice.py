"""Choice of a spatial arm's model: terms are added as long as the recording supports them.

Torque scales are not chosen this way: they belong to the model whenever the torque constants are uncertain.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from hil.estimator.chain.identify import ChainEstimate, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError


@dataclass(frozen=True)
class ChoiceOptions:
    """Options for model selection."""

    significance: float = 1e-3
    """Significance level at which a term is kept (likelihood ratio, corrected for the residual's correlation)."""


OPTIONS = ChoiceOptions()


@dataclass(frozen=True)
class ChainTrial:
    """A model that was tried, and its fit."""

    model: ChainModel
    estimate: ChainEstimate | None
    """Result of the fit; None if it did not converge."""
    seconds: float
    """Duration of the fit [s]."""

    @property
    def error(self) -> float:
        """RMS error of the one-step-ahead prediction over all joints, in units of the noise; infinite without a fit."""
        return np.inf if self.estimate is None else float(np.sqrt(np.mean(np.square(self.estimate.over_noise))))


@dataclass(frozen=True)
class ChainChoice:
    """The best-supported estimate, and all models tried, simplest first."""

    estimate: ChainEstimate
    trials: tuple[ChainTrial, ...]

    @property
    def gained(self) -> float:
        """Ratio of the simplest model's error to that of the chosen model."""
        return self.trials[0].error / ChainTrial(self.estimate.model, self.estimate, 0.0).error


def choose_chain(
    periods: SettledPeriod | Sequence[SettledPeriod], model: ChainModel, prior: Prior, options: ChoiceOptions = OPTIONS
) -> ChainChoice:
    """Fit `model`, and richer models if its residual exceeds the noise; choose the best-supported estimate.

    Raises any error that `identify_chain` raises for `model` itself.
    """
    started = time.perf_counter()
    best = identify_chain(periods, model, prior, test_zeros=True)
    trials = [ChainTrial(model, best, time.perf_counter() - started)]
    while not best.explained:
        found = [_tried(periods, richer, prior) for richer in _richer(best.model)]
        trials += found
        gains = [(_gain(best, each.estimate, options), each.estimate) for each in found if each.estimate is not None]
        if not gains:
            break
        gain, better = max(gains, key=lambda pair: pair[0])
        if gain <= 0.0:
            break
        best = better
    return ChainChoice(best, tuple(trials))


def _richer(model: ChainModel) -> list[ChainModel]:
    more = [] if model.zeros or model.joints == 1 else [replace(model, zeros=True)]
    if model.friction == "coulomb":
        more.append(replace(model, friction="stribeck"))
    if model.friction == "stribeck":
        more.append(replace(model, friction="stribeck_load"))
    return more


def _tried(periods: SettledPeriod | Sequence[SettledPeriod], model: ChainModel, prior: Prior) -> ChainTrial:
    started = time.perf_counter()
    try:
        estimate = identify_chain(periods, model, prior, test_zeros=True)
    except ConvergenceError:
        estimate = None
    return ChainTrial(model, estimate, time.perf_counter() - started)


def _gain(simple: ChainEstimate, rich: ChainEstimate, options: ChoiceOptions) -> float:
    """For unknown noise levels, return twice the gain in log likelihood, less the amount expected by chance.

    The residual's correlation is taken from the richer model, since the residual of the simpler one also contains the
    effects of the missing terms.
    """
    before, after = (np.nansum(np.square(each.residual), axis=1) for each in (simple, rich))
    samples = np.isfinite(simple.residual).sum(axis=1)
    ratio = samples * np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
    added = len(rich.names) - len(simple.names)
    level = float(chdtri(added, options.significance))
    return float(ratio.sum()) / max(rich.correlation_time, 1.0) - level
