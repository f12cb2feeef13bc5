"""Conversion of the findings of an estimate's checks to the form stored in a result."""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.choice import ChainChoice
from hil.estimator.selection import distortion, trial, unsettled, validation, verdict
from hil.results.parts import (
    Confounded,
    Levels,
    LineGroup,
    LineLevels,
    ModelChoice,
    PerJoint,
    TriedModel,
    Validation,
    Verdict,
)


def describe_validation(
    found: validation.Validation,
    held_out: Array | None,
    held_out_as_fitted: Array | None = None,
) -> Validation:
    """Convert a validation to the form stored in a result.

    held_out, held_out_as_fitted: as in `hil.estimator.selection.verdict.Evidence`.
    """
    first, second, correlation = found.confounded
    levels, lines = found.levels, found.levels.lines
    return Validation(
        held_out_rms=_listed(held_out),
        held_out_as_fitted_rms=_listed(held_out_as_fitted),
        free_run_rms=_listed(found.free_run),
        residual_over_floor=_listed(found.residual_over_floor),
        correlated_lags=_listed(found.correlated_lags),
        condition=found.condition,
        hardest_to_tell_apart=Confounded((first, second), correlation),
        levels_ticks=Levels(
            excited_lines=_per_joint(levels.excited),
            distortion=_per_joint(levels.distortion),
            noise=_per_joint(levels.noise),
            period_scatter=_per_joint(levels.scatter),
            model_error=_per_joint(levels.model_error),
        ),
        line_levels_ticks=LineLevels(
            noise=_per_joint(lines.noise),
            excited=_group(lines.excited),
            odd=_group(lines.odd),
            even=_group(lines.even),
            other=_group(lines.other),
        ),
    )


def _per_joint(values: Array) -> PerJoint:
    return tuple(values.tolist())


def _listed(values: Array | None) -> PerJoint | None:
    return None if values is None else _per_joint(values)


def _group(group: distortion.LineGroup | None) -> LineGroup | None:
    return None if group is None else LineGroup(group.lines, _per_joint(group.motion), _per_joint(group.left))


def describe_verdict(judged: verdict.Verdict) -> Verdict:
    """Convert the estimator's verdict to the form stored in a result."""
    return Verdict(judged.trust, judged.weakest, tuple(judged.sentences))


def describe_choice(choice: trial.Choice) -> ModelChoice:
    """Convert the choice among friction models, with its gain and cost, to the form stored in a result."""
    return ModelChoice(
        chosen=choice.chosen.model.description,
        error_divided_by=choice.gained,
        standard_errors_times=choice.cost,
        tried=tuple(_tried(trial) for trial in choice.trials),
    )


def describe_segment_choice(choice: unsettled.SegmentChoice) -> ModelChoice:
    """Convert the choice among models for unsettled data (by held-out segments) to the form stored in a result."""
    return ModelChoice(
        chosen=choice.chosen.model.description,
        error_divided_by=choice.gained,
        tried=tuple(_tried(trial) for trial in choice.trials),
    )


def describe_chain_choice(choice: ChainChoice) -> ModelChoice:
    """Convert the choice among models of a spatial arm (by one-step predictions) to the form stored in a result."""
    return ModelChoice(
        chosen=choice.estimate.model.description,
        error_divided_by=choice.gained,
        tried=tuple(
            TriedModel(
                model=each.model.description,
                parameters=len(each.model.names),
                held_out_rms=None,
                score=each.error if np.isfinite(each.error) else None,
                seconds=round(each.seconds, 3),
            )
            for each in choice.trials
        ),
    )


def _tried(tried: trial.Trial | unsettled.SegmentTrial) -> TriedModel:
    return TriedModel(
        model=tried.model.description,
        parameters=len(tried.model.names),
        held_out_rms=_listed(tried.held_out),
        score=tried.score if np.isfinite(tried.score) else None,
        seconds=round(tried.seconds, 3),
    )
