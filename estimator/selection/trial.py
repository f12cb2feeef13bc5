"""Fitted models with their performance, the choice among them, and the data to which they are fitted."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError, PeriodicityError
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.options import IntegrationOptions, LikelihoodOptions, MinimiserOptions
from hil.estimator.selection.drift import Drift
from hil.estimator.selection.other_period import predict_period

THOROUGH = LikelihoodOptions()
QUICK = LikelihoodOptions(
    minimiser=MinimiserOptions(max_iterations=25, unfinished=1.0),
    integration=IntegrationOptions(max_substeps=16),
    coarse_integration=IntegrationOptions(max_step=2.6e-3, max_substeps=8),
)
"""Options for quick fits: few iterations and substeps, to lose little time if bristles become extremely stiff."""


@dataclass(frozen=True)
class Trial:
    """A model and its performance."""

    model: Model
    estimate: Estimate | None
    """Result of the fit; None if the fit or the prediction did not converge."""
    held_out: Array | None
    """RMS error of the open-loop prediction of the held-out motion, relative to that motion's RMS (joints,)."""
    score: float
    """RMS error of the held-out motion's prediction in units of the noise; without a held-out motion, the result of
    `criterion`.
    """
    seconds: float
    coarse: bool = False
    """Whether the fit was allowed to end early if it left much of the motion unexplained."""

    @property
    def has_standard_errors(self) -> bool:
        """Whether the fit succeeded and any base parameter has a finite standard error."""
        if self.estimate is None:
            return False
        return bool(np.isfinite(self.estimate.std[: len(self.model.base_names)]).any())


@dataclass(frozen=True)
class Choice:
    """The models tried, in order, and which of them was chosen."""

    trials: tuple[Trial, ...]
    chosen: Trial
    period: SettledPeriod
    """The first period as it was fitted: corrected for a change in friction, if one was found."""
    drift: Drift | None = None
    """The change in friction for which the period was corrected; None for no correction."""

    @property
    def estimate(self) -> Estimate:
        """The estimate of the chosen model."""
        if self.chosen.estimate is None:
            raise ConvergenceError(f"{self.chosen.model.description} did not converge to full precision")
        return self.chosen.estimate

    @property
    def plainest(self) -> Trial:
        """The trial with the fewest parameters among those that could be fitted."""
        judged = [each for each in self.trials if each.estimate is not None]
        judged = [each for each in judged if np.isfinite(each.score)] or judged
        return min(judged, key=lambda each: len(each.model.names))

    @property
    def gained(self) -> float:
        """Ratio of the simplest model's prediction error to the chosen model's."""
        return self.plainest.score / self.chosen.score

    @property
    def cost(self) -> float:
        """Factor by which the added terms increase the standard errors of the base parameters (geometric mean).

        The reference is what the standard errors would be if the added terms were known exactly.
        """
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
        told = np.sum(across * (linalg.pinv(correlation[np.ix_(added, added)]) @ across), axis=0)
        return float(np.exp(-0.5 * np.mean(np.log1p(-np.clip(told, 0.0, 1.0 - 1e-9)))))


@dataclass(frozen=True)
class Fitting:
    """The data for fitting models to one set of periods, in a form that can be passed to another process."""

    periods: Sequence[SettledPeriod]
    held_out: SettledPeriod | None
    starts: Sequence[Mapping[str, float]]
    drift: Drift | None = None
    """Change in friction from the fitted periods to `held_out`, for which both are corrected."""

    def trial(self, model: Model, near: Trial | None, values: Mapping[str, float], coarse: bool) -> Trial:
        """Fit `model` from scratch or from the result of `near`, in which `values` replace or add parameters.

        Raises ConvergenceError.
        """
        started = time.perf_counter()
        place = None
        if near is not None and near.estimate is not None:
            place = Near({**near.estimate.parameters, **values}, near.estimate.start)
        options = QUICK if coarse and "presliding" in model.options else THOROUGH
        estimate = identify(self.periods, model, starts=self.starts, near=place, coarse=coarse, options=options)
        relative, score = self._predicted(estimate)
        return Trial(model, estimate, relative, score, time.perf_counter() - started, coarse)

    def _predicted(self, estimate: Estimate) -> tuple[Array | None, float]:
        other = self.held_out
        if other is None:
            return None, criterion(estimate, self.periods)
        try:
            later = estimate if self.drift is None else self.drift.at_the_later(estimate)
            predicted = predict_period(later, other)
        except PeriodicityError:
            return None, np.inf
        return relative_error(other.position, predicted), float(
            np.sqrt(np.nanmean(((other.position - predicted) / other.noise[:, None]) ** 2))
        )


def criterion(estimate: Estimate, periods: Sequence[SettledPeriod]) -> float:
    """Return exp(BIC / 2n) of the residual in units of the noise, which is comparable to a prediction error.

    BIC: Bayesian information criterion. n: number of samples, reduced according to the residual's correlation.
    """
    noise = periods[0].noise
    size = np.nanmean((estimate.residual / noise[:, None]) ** 2)
    samples = sum(period.valid.sum() for period in periods) / estimate.correlation_time
    return float(np.sqrt(size) * np.exp(0.5 * len(estimate.names) * np.log(samples) / samples))
