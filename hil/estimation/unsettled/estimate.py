"""Estimates from recordings without a settled period: CSV files, and runs that were cut short."""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.config.chain import only_planar
from hil.config.csv_columns import load_csv_config
from hil.config.experiment import ModelConfig
from hil.errors import ConfigError
from hil.estimation.model_from_config import wanted_model
from hil.estimation.physical import physical_of
from hil.estimation.result_checks import describe_segment_choice
from hil.estimation.settled_warnings import clipping_warnings
from hil.estimation.unsettled.csv_recording import read_csv
from hil.estimation.unsettled.warnings import any_warnings
from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.selection.unsettled import choose_by_shooting
from hil.results.parts import Covariance, Quantity, ShootingFit, Timing, Zeros
from hil.results.result import ShootingResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

log = logging.getLogger(__name__)

START_CUTOFF = 8.0  # Hz, filter of the inverse dynamics that give the initial guess
START_WIDTH = 0.05  # rad/s


def estimate_csv(paths: Sequence[Path], config_path: Path) -> ShootingResult:
    """Estimate from one or more CSV files of the same arm. Raises HilError, EstimationError."""
    config = load_csv_config(config_path)
    columns = config.columns
    recordings = [read_csv(path, columns) for path in paths]
    zeros = (columns.zeros_unknown or config.model.zeros) and config.arm.gravity > 0.0
    result = _estimate(recordings, config.model, columns.segment, zeros, str(config_path))
    names = tuple(map(str, paths))
    result = replace(result, recordings=names)
    if result.zeros is not None:
        named = zip(names, result.zeros, strict=True)
        result = replace(result, zeros=tuple(replace(found, recording=name) for name, found in named))
    if config.known is not None:
        result = replace(result, physical=physical_of(result, config.known.quantities(), config.arm.gravity))
    return result


def estimate_unsettled(run: RunFolder) -> ShootingResult:
    """Estimate from all samples of a run that never became periodic or was stopped before it did."""
    config, facts = run.load_config(), run.load_facts()
    only_planar(config, "an estimate from all samples")
    samples = load_samples(run.samples_path, len(config.joints))
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    recording = Recording(
        samples["time_before_write"] - samples["time_before_write"][:1],
        (samples["goal_current"] * constants).T,
        samples["position"].T.copy(),
        np.array(facts.position_step),
        between="held",
        command_to_sample=facts.command_to_sample,
    )
    result = _estimate([recording], config.model, 1.0, config.model.zeros, facts.config)
    result = replace(result, warnings=(*result.warnings, *clipping_warnings(config, samples)))
    run.write_result(result)
    return result


def _estimate(
    recordings: Sequence[Recording], wanted: ModelConfig, segment: float, zeros: bool, shown_path: str
) -> ShootingResult:
    if wanted.ripple:
        raise ConfigError(
            "model.ripple needs a settled period to find its cycles per turn: remove it for unsettled data."
        )
    began = time.perf_counter()
    start = fit_inverse_dynamics(recordings, START_CUTOFF, START_WIDTH).value
    choice = None
    if wanted.friction == "auto":
        choice = choose_by_shooting(
            recordings, wanted.drive, start, length=segment, zeros=zeros, torque_scale=wanted.torque_scale
        )
        estimate = choice.estimate
    else:
        # Encoder zeros are estimated for each recording instead.
        model = wanted_model(wanted, recordings[0].joints).without("zeros")
        estimate = estimate_by_shooting(recordings, model, start, length=segment, zeros=zeros)
    result = make_shooting_result(estimate, recordings, shown_path, round(time.perf_counter() - began, 3))
    result = replace(result, warnings=tuple(any_warnings(recordings, estimate)))
    log.info("%s: %s", shown_path, result.method)
    for warning in result.warnings:
        log.warning("%s: %s", shown_path, warning)
    return result if choice is None else replace(result, model_choice=describe_segment_choice(choice))


def make_shooting_result(
    estimate: ShootingEstimate, recordings: Sequence[Recording], shown_path: str, seconds: float
) -> ShootingResult:
    """Build the result of multiple shooting.

    shown_path: the configuration's path, as shown to the user. seconds: duration of the estimation [s].
    """
    base = len(estimate.model.base_names)
    entries = [
        (name, Quantity(float(value), float(std), unit))
        for name, value, std, unit in zip(estimate.names, estimate.value, estimate.std, estimate.units, strict=True)
    ]
    steps = np.max([recording.position_step for recording in recordings], axis=0)
    zeros = tuple(
        Zeros(zero=tuple(zero.tolist()), std=tuple(std.tolist()))
        for zero, std in zip(estimate.zeros, estimate.zeros_std, strict=True)
    )
    return ShootingResult(
        method=f"multiple shooting: {estimate.segments} segments of {estimate.segment_length:g} s with unknown "
        f"initial states; {estimate.model.description}; standard errors robust against model error",
        config=shown_path,
        joints=estimate.model.joints,
        parameters=dict(entries[:base]),
        extra=dict(entries[base:]),
        covariance=Covariance(tuple(estimate.names), tuple(map(tuple, estimate.covariance.tolist()))),
        fit=ShootingFit(
            residual_rms_rad=tuple(estimate.residual_rms.tolist()),
            residual_rms_ticks=tuple((estimate.residual_rms / steps).tolist()),
            samples=int(sum(recording.time.size for recording in recordings)),
            segments=estimate.segments,
        ),
        timing=Timing(estimation_seconds=seconds),
        zeros=zeros or None,
    )
