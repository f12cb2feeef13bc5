"""Friction model selection for recordings without a settled period.

As for settled periods (`hil.estimator.selection.settled`), Stribeck friction is fitted first. If it does not explain
the motion, or if score tests find a significant term, all other smooth terms are added at once, with their typical
sizes as a prior; then insignificant terms are removed.

If the motion is explained down to the noise, the likelihood decides. Otherwise, since a richer model may merely
compensate for another missing term, the model is fitted to alternate segments of each recording and predicts the rest;
models with presliding friction are tried as well.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.data.segments import Grid, cut
from hil.estimator.errors import ConvergenceError, RecordingError
from hil.estimator.fit.multiple_shooting import ALL, ShootingEstimate, estimate_by_shooting
from hil.estimator.models.model import Model
from hil.estimator.models.terms import FRICTIONS, Drive, Option
from hil.estimator.options import SelectionOptions, ShootingOptions
from hil.estimator.selection.pruning import pruned_model
from hil.estimator.selection.segments import held_out_errors, missing_terms

DEFAULTS = SelectionOptions()
FITTED, PREDICTED = slice(0, None, 2), slice(1, None, 2)
SMOOTH: tuple[Option, ...] = ("asymmetry", "saturation", "cable")
"""Terms whose effect vanishes smoothly at zero, so that including them adds little cost to a fit."""
FINE = ShootingOptions()
QUICK = ShootingOptions(ftol=1e-3, max_step=FINE.coarse_step, reweightings=1)
"""Options for fits that are only compared with each other."""
QUICK_PRESLIDING = replace(QUICK, max_substeps=16)
"""The same for models with presliding; few substeps, since extremely stiff bristles would always need the maximum."""
EXPLAINED = 1.1  # ratio of residual to noise for an explained motion; the noise is estimated from the same samples
HOPELESS = 0.3  # prediction error relative to the motion, above which a fit is useless and is not refined
NEARLY = 1.5  # ratio of residual to noise up to which the likelihood can be trusted to choose


@dataclass(frozen=True)
class SegmentTrial:
    """A model and its prediction error on the held-out segments."""

    model: Model
    held_out: Array | None
    """RMS error relative to the motion's RMS (joints,); None if the fit did not converge."""
    score: float
    """Median of the segments' relative errors over all joints."""
    seconds: float


@dataclass(frozen=True)
class SegmentChoice:
    """The models tried, in order, with the chosen model and its fit to all segments."""

    trials: tuple[SegmentTrial, ...]
    chosen: SegmentTrial
    estimate: ShootingEstimate
    plain: ShootingEstimate
    """The first fit, without terms that could imitate a defect of the recordings."""

    @property
    def gained(self) -> float:
        """Ratio of the simplest model's prediction error to the chosen model's."""
        fitted = [each for each in self.trials if each.held_out is not None]
        return min(fitted, key=lambda each: len(each.model.names)).score / self.chosen.score


def choose_by_shooting(
    recordings: Sequence[Recording],
    drive: Drive,
    start: Array,
    *,
    length: float = 1.0,
    zeros: bool = False,
    torque_scale: bool = False,
    options: SelectionOptions = DEFAULTS,
) -> SegmentChoice:
    """Fit a friction model with the terms that the recordings support.

    Arguments as for `estimate_by_shooting`. torque_scale: whether to fit the ratio of the torque constants even if the
    recordings do not support it.

    Raises RecordingError if no recording has two segments, ConvergenceError if no model can be fitted.
    """
    if not any(len(cut(each, 0, Grid.of(each), length)) > 1 for each in recordings):
        longest = max(float(np.ptp(each.time)) for each in recordings)
        raise RecordingError(
            f"no recording has two segments of {length:g} s, one to fit and one to check; the longest recording lasts "
            f"{longest:.3g} s: record for longer, choose shorter segments (columns.segment), or set model.friction to "
            "a specific model"
        )
    joints = recordings[0].joints
    unknown: tuple[Option, ...] = ("torque_scale", "lags") if joints == 2 else ()
    search = _Search(recordings, start, length, zeros, options, "torque_scale" if torque_scale else None)
    plain = search.fit(Model(joints, "stribeck", drive, unknown), options=QUICK)
    if plain is None:
        plain = search.fit(Model(joints, "coulomb", drive), options=QUICK)
    if plain is None:
        raise ConvergenceError("no friction model could be fitted: check order, signs, units and zeros of the columns")
    best = search.grown(plain)
    return search.judged(plain, best)


def held_out_error(recordings: Sequence[Recording], estimate: ShootingEstimate, start: Array) -> Array | None:
    """Fit the estimate's model to alternate segments and return its prediction error on the remaining ones (joints,).

    The error is the RMS error relative to the motion's RMS. Returns None if the fit does not converge or no recording
    has two segments. start: initial guess as in `estimate_by_shooting`.
    """
    length, zeros = estimate.segment_length, bool(estimate.zeros.size)
    if not any(len(cut(each, 0, Grid.of(each), length)) > 1 for each in recordings):
        return None
    search = _Search(recordings, start, length, zeros, DEFAULTS, None)
    return search.trial(estimate, estimate.model).held_out


class _Search:
    """Fits of one set of recordings, each starting from the result of an earlier one."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        start: Array,
        length: float,
        zeros: bool,
        options: SelectionOptions,
        fixed: Option | None,
    ) -> None:
        self._recordings = recordings
        self._start = start
        self._length = length
        self._zeros = zeros
        self._options = options
        self._fixed = fixed
        self._trials: dict[Model, SegmentTrial] = {}

    def fit(
        self,
        model: Model,
        near: ShootingEstimate | None = None,
        of: slice = ALL,
        options: ShootingOptions = FINE,
    ) -> ShootingEstimate | None:
        try:
            return estimate_by_shooting(
                self._recordings,
                model,
                self._start,
                length=self._length,
                zeros=self._zeros,
                of=of,
                near=near,
                options=options,
            )
        except ConvergenceError:
            return None

    def trial(self, near: ShootingEstimate, model: Model) -> SegmentTrial:
        """Fit `model`, starting from `near`, and return how well it predicts segments that were held out of the fit.

        `near` only determines which local minimum is found.
        """
        if model not in self._trials:
            began = time.perf_counter()
            half = self.fit(model, near, FITTED, _quick(model))
            error, score = (None, np.inf) if half is None else held_out_errors(self._recordings, half, PREDICTED)
            self._trials[model] = SegmentTrial(model, error, score, time.perf_counter() - began)
        return self._trials[model]

    def grown(self, plain: ShootingEstimate) -> ShootingEstimate:
        """Return the estimate with the richest model that the recordings support."""
        if _left(plain) < EXPLAINED and not self._seen(plain):
            return self._pruned(plain)
        smooth = replace(plain.model, friction=FRICTIONS[-1]).having(*SMOOTH)
        rich = self.fit(smooth, plain, options=QUICK)
        if rich is not None and _left(rich) < NEARLY:
            kept = rich if self._gain(rich, plain) > self._worth(rich, plain) else plain
            return self._pruned(kept)
        return self._by_prediction(plain)

    def _by_prediction(self, plain: ShootingEstimate) -> ShootingEstimate:
        """Return the estimate whose model predicts best; used if no model explains the motion."""
        best, near = self.trial(plain, plain.model), plain
        loaded = replace(plain.model, friction=FRICTIONS[-1])
        for richer in (loaded, loaded.having("presliding"), loaded.having(*SMOOTH)):
            model = richer.having("presliding") if "presliding" in best.model.options else richer
            found = self.trial(near, model)
            if found.score < self._options.keep_ratio * best.score:
                best = found
        return self.fit(best.model, near, options=_final(best)) or plain

    def judged(self, plain: ShootingEstimate, best: ShootingEstimate) -> SegmentChoice:
        """Return the choice: `best`, or the simplest model if it predicts held-out segments much better. If no model
        explains the motion, any improvement suffices.
        """
        best = self._with_standard_errors(best, plain)
        simple = Model(plain.model.joints, "coulomb", plain.model.drive)
        plainest, chosen = self.trial(plain, simple), self.trial(best, best.model)
        ratio = self._options.overrule_ratio if _left(best) < EXPLAINED else 1.0
        if plainest.score < ratio * chosen.score:
            best, chosen = self.fit(simple, plain, options=_final(plainest)) or best, plainest
        if not np.isfinite(chosen.score):
            raise ConvergenceError("no friction model could be fitted to half of the segments: record for longer")
        return SegmentChoice(tuple(self._trials.values()), chosen, best, plain)

    def _with_standard_errors(self, best: ShootingEstimate, plain: ShootingEstimate) -> ShootingEstimate:
        """Return `best`, or a simpler estimate if no parameter of `best` has a standard error, as can happen with
        extremely stiff bristles.
        """
        for model in (best.model, best.model.without("presliding"), plain.model):
            found = best if model == best.model else self.fit(model, plain)
            if found is not None and np.isfinite(found.std).any():
                return found
        return best

    def _seen(self, estimate: ShootingEstimate) -> bool:
        found = missing_terms(self._recordings, estimate)
        return bool(found) and found[0].evidence > 1.0

    def _pruned(self, best: ShootingEstimate) -> ShootingEstimate:
        for level in self._options.prune_levels:
            model = pruned_model(best.model, best.names, best.value, best.covariance, level, self._fixed)
            if model == best.model:
                continue
            plainer = self.fit(model, best, options=QUICK)
            if plainer is not None and self._gain(best, plainer) < self._worth(best, plainer):
                best = plainer
                break
        return self.fit(best.model, best) or best

    def _gain(self, richer: ShootingEstimate, plainer: ShootingEstimate) -> float:
        """Return twice the gain in log-likelihood."""
        return 2.0 * self._samples * float(np.log(_left(plainer) / _left(richer)))

    def _worth(self, richer: ShootingEstimate, plainer: ShootingEstimate) -> float:
        """Return the gain required of additional terms: the penalty of the Bayesian information criterion."""
        return max(1, len(richer.names) - len(plainer.names)) * float(np.log(self._samples))

    @property
    def _samples(self) -> float:
        return float(sum(np.isfinite(each.position).sum() for each in self._recordings))


def _quick(model: Model) -> ShootingOptions:
    return QUICK_PRESLIDING if "presliding" in model.options else QUICK


def _final(chosen: SegmentTrial) -> ShootingOptions:
    """Return the options for the final fit of the chosen model."""
    is_hopeless = chosen.held_out is None or float(chosen.held_out.max()) > HOPELESS
    return _quick(chosen.model) if is_hopeless else FINE


def _left(estimate: ShootingEstimate) -> float:
    """Return the RMS residual in units of the noise."""
    return max(1e-6, float(np.sqrt(np.mean(estimate.residual_over_noise**2))))
