"""What the checks of an estimate found, as result.json keeps it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.estimator.selection.distortion import LineGroup
from hil.estimator.selection.settled import Choice, Trial
from hil.estimator.selection.unsettled import SegmentChoice, SegmentTrial
from hil.estimator.selection.validation import Validation
from hil.estimator.selection.verdict import Verdict


def describe_validation(validation: Validation, held_out: NDArray[np.float64] | None) -> dict[str, Any]:
    """Per joint; `held_out_rms` and `free_run_rms` are fractions of the motion's RMS, `levels_ticks` encoder steps RMS
    of all lines together, `line_levels_ticks` of one line."""
    levels = validation.levels
    first, second, correlation = validation.confounded
    described: dict[str, Any] = {} if held_out is None else {"held_out_rms": held_out.tolist()}
    if validation.free_run is not None:
        described["free_run_rms"] = validation.free_run.tolist()
    return {
        **described,
        "residual_over_floor": validation.residual_over_floor.tolist(),
        "correlated_lags": validation.correlated_lags.tolist(),
        "condition": validation.condition,
        "hardest_to_tell_apart": {"parameters": [first, second], "correlation": correlation},
        "levels_ticks": {
            "excited_lines": levels.excited.tolist(),
            "distortion": levels.distortion.tolist(),
            "noise": levels.noise.tolist(),
            "period_scatter": levels.scatter.tolist(),
            "model_error": levels.model_error.tolist(),
        },
        "line_levels_ticks": {
            "noise": levels.lines.noise.tolist(),
            **_group("excited", levels.lines.excited),
            **_group("odd", levels.lines.odd),
            **_group("even", levels.lines.even),
            **_group("other", levels.lines.other),
        },
    }


def _group(name: str, group: LineGroup | None) -> dict[str, Any]:
    """How many lines, the motion on one of them and what the fit leaves of it; nothing where there are none."""
    if group is None:
        return {}
    return {name: {"lines": group.lines, "motion": group.motion.tolist(), "left": group.left.tolist()}}


def describe_verdict(verdict: Verdict) -> dict[str, Any]:
    """`trust`: yes, with care or no; `weakest`: a parameter; `sentences`: why, for a person."""
    return {"trust": verdict.trust, "weakest": verdict.weakest, "sentences": list(verdict.sentences)}


def describe_choice(choice: Choice) -> dict[str, Any]:
    """Which friction model was chosen of which, and what that gained and cost."""
    return {
        "chosen": choice.chosen.model.description,
        "error_divided_by": choice.gained,
        "standard_errors_times": choice.cost,
        "tried": [_tried(trial) for trial in choice.trials],
    }


def describe_segment_choice(choice: SegmentChoice) -> dict[str, Any]:
    """The same for any data, judged by segments that were left out of the fit."""
    return {
        "chosen": choice.chosen.model.description,
        "error_divided_by": choice.gained,
        "tried": [_tried(trial) for trial in choice.trials],
    }


def _tried(trial: Trial | SegmentTrial) -> dict[str, Any]:
    return {
        "model": trial.model.description,
        "parameters": len(trial.model.names),
        "held_out_rms": None if trial.held_out is None else trial.held_out.tolist(),
        "score": trial.score if np.isfinite(trial.score) else None,
        "seconds": round(trial.seconds, 3),
    }
