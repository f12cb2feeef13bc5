"""Friction model selection for recordings without a settled period, judged on held-out segments.

Every other segment of each recording is fitted, and the remaining ones are predicted, each from the initial state given
by its first samples. The model that predicts them best is finally fitted to all segments. (The short segments used for
initial guesses are not split in this way, but the models that are compared only use their half.)
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.data.segments import Grid, cut
from hil.estimator.errors import ConvergenceError, RecordingError
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.models.model import Model
from hil.estimator.models.terms import FRICTIONS, Drive, Option
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.prediction import prediction_errors

DEFAULTS = SelectionOptions()
FITTED, PREDICTED = slice(0, None, 2), slice(1, None, 2)


@dataclass(frozen=True)
class SegmentTrial:
    """One model and its prediction error on the held-out segments."""

    model: Model
    held_out: Array | None
    """RMS error relative to the motion's RMS (joints,); None if the fit did not converge."""
    score: float
    """Median of the segments' relative errors over all joints: a segment in which the arm turns over can be far off."""
    seconds: float


@dataclass(frozen=True)
class SegmentChoice:
    """The models tried, in order, the chosen one, and its fit to all segments."""

    trials: tuple[SegmentTrial, ...]
    chosen: SegmentTrial
    estimate: ShootingEstimate

    @property
    def gained(self) -> float:
        """Ratio of the simplest model's error to the chosen one's."""
        return self.trials[0].score / self.chosen.score


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
    """Fit increasingly rich friction models as long as the prediction of held-out segments improves.

    Presliding and asymmetry are then tried with the best of them. Arguments as in `estimate_by_shooting`;
    `torque_scale` is part of every model or of none. Raises RecordingError for recordings with fewer than two segments
    each, ConvergenceError if no model can be fitted.
    """
    if not any(len(cut(each, 0, Grid.of(each), length)) > 1 for each in recordings):
        raise RecordingError(
            f"no recording has two segments of {length:g} s, one to fit and one to check: set model.friction to a "
            "specific model, record longer, or choose shorter segments"
        )

    def tried(model: Model) -> SegmentTrial:
        return _try(recordings, model, start, length, zeros)

    joints = recordings[0].joints
    always: tuple[Option, ...] = ("torque_scale",) if torque_scale else ()
    trials = [tried(Model(joints, friction, drive, always)) for friction in FRICTIONS]
    best = trials[0]
    for trial in trials[1:]:
        best = trial if trial.score < options.keep_ratio * best.score else best
    further: tuple[Option, ...] = ("presliding", "asymmetry")
    for option in further:
        trials.append(tried(best.model.having(option)))
        best = trials[-1] if trials[-1].score < options.keep_ratio * best.score else best
    if best.held_out is None:
        raise ConvergenceError("no friction model could be fitted: check the recording and its units")
    estimate = estimate_by_shooting(recordings, best.model, start, length=length, zeros=zeros)
    return SegmentChoice(tuple(trials), best, estimate)


def _try(recordings: Sequence[Recording], model: Model, start: Array, length: float, zeros: bool) -> SegmentTrial:
    began = time.perf_counter()
    try:
        found = estimate_by_shooting(recordings, model, start, length=length, zeros=zeros, of=FITTED)
    except ConvergenceError:
        return SegmentTrial(model, None, np.inf, time.perf_counter() - began)
    shifts = found.zeros if zeros else None
    errors, _ = prediction_errors(recordings, found.parameters, length, model.joints, shifts, PREDICTED)
    motion = np.sqrt(np.mean([np.var(each.filled(), axis=1) for each in recordings], axis=0))
    relative = errors / motion
    score = float(np.median(np.sqrt(np.mean(relative**2, axis=1))))
    held_out = np.sqrt(np.mean(relative**2, axis=0))
    return SegmentTrial(model, held_out, score, time.perf_counter() - began)
