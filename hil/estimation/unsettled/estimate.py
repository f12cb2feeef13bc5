"""Estimates from recordings that hold no settled period: other tools' files, and runs that were cut short."""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hil.config.chain import only_planar
from hil.config.experiment import ModelConfig
from hil.errors import ConfigError
from hil.estimation.drive.currents import current_findings
from hil.estimation.model_from_config import wanted_model
from hil.estimation.plausibility import link_length, torque_scale_std, wrong_length
from hil.estimation.result import arm_facts
from hil.estimation.result_checks import describe_segment_choice, describe_verdict
from hil.estimation.slips.position_jumps import jump_warnings
from hil.estimation.torque_constants import Source, contradictions, ratios_of, ratios_said
from hil.estimation.unsettled.angle_scale import angle_scale
from hil.estimation.unsettled.causes import Fitted, are_known, causes
from hil.estimation.unsettled.plausibility import implausible, undetermined
from hil.estimation.unsettled.warnings import Doubts, doubts_of
from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.models.conflicts import Conflict, conflicts
from hil.estimator.models.parameters import CONSTANTS, OWN_INERTIA
from hil.estimator.selection.segment_verdict import SegmentEvidence, judge_segments
from hil.estimator.selection.segments import considered, missing_terms, predicted_positions
from hil.estimator.selection.unsettled import SegmentChoice, choose_by_shooting, held_out_error
from hil.estimator.selection.verdict import Verdict
from hil.results.parts import Covariance, Quantity, ShootingFit, Timing, Validation, Zeros
from hil.results.result import ShootingResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

log = logging.getLogger(__name__)

START_CUTOFFS = (8.0, 4.0, 2.0)  # Hz; the first usable one serves for inverse dynamics, which gives the initial guess
START_WIDTH = 0.05  # rad/s
JUMPED = (
    "A position jumped (see the warnings), so angles before and after the jump are inconsistent: use only the part "
    "before or after it, or put each part in a separate file."
)
LAG_S = 1e-3  # lag of a motor's current behind its voltage; 0.1 to 2 ms for small motors
NOT_HERE = ("ripple", "cogging", "encoder")


@dataclass(frozen=True)
class Estimated:
    """An estimate from recordings. result: complete except for the fields that the caller fills in. predicted:
    positions per recording (joints, samples) [rad]; NaN if there are none.
    """

    result: ShootingResult
    predicted: tuple[Array, ...]
    estimate: ShootingEstimate


@dataclass(frozen=True)
class Given:
    """Prior knowledge of the drives and encoders.

    torque_scale_std: relative standard deviation of the ratio of the torque constants, by parameter. zeros: whether a
    configuration defines the encoder zeros. names: names of the recordings. jumps: a sentence for each position
    jump of a joint in a recording. torque_source: where the torques come from. origin: the angles [rad] at which the
    position columns are 0, by default 0. repeats: whether each recording is the mean of similar periods. length:
    measured length of link 1 [m].
    """

    torque_scale_std: Mapping[str, float] = field(default_factory=dict)
    zeros: bool = False
    names: tuple[str, ...] = ()
    jumps: tuple[str, ...] = ()
    torque_source: Source = "column"
    origin: tuple[float, ...] = ()
    repeats: bool = False
    length: float | None = None
    brakes: tuple[float | None, ...] = ()
    """Part of each voltage-driven joint's viscous friction that is due to back-EMF [N m s/rad]; None if unknown."""


def estimate_unsettled(run: RunFolder) -> ShootingResult:
    """Estimate from all samples of a run whose motion never became periodic."""
    config, facts = run.load_config(), run.load_facts()
    only_planar(config, "an estimate from all samples")
    samples = load_samples(run.samples_path, len(config.joints))
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    written: Array = samples["time_before_write"]
    goals: Array = samples["goal_current"]
    recording = Recording(
        written - written[:1],
        (goals * constants).T,
        samples["position"].T.copy(),
        np.array(facts.position_step),
        between="held",
        command_to_sample=facts.command_to_sample,
    )
    jumps = tuple(jump_warnings(config, facts, samples))
    length = link_length(config.known, config.arm)
    given = Given(torque_scale_std(config), zeros=True, jumps=jumps, torque_source="constant", length=length)
    zeros, gravity = config.model.zeros, config.arm.gravity
    result = estimate_any([recording], config.model, 1.0, zeros, facts.config, gravity, given=given).result
    seldom = (facts.monitoring,) if facts.monitoring else ()
    warnings = (*result.warnings, *current_findings(config, samples).warnings, *seldom)
    result = replace(result, arm=arm_facts(config), warnings=warnings)
    run.write_result(result)
    return result


def estimate_any(
    recordings: Sequence[Recording],
    wanted: ModelConfig,
    segment: float,
    zeros: bool,
    shown_path: str,
    gravity: float,
    stepped: Sequence[bool] = (),
    given: Given = Given(),
) -> Estimated:
    """The estimate, its checks and its verdict. stepped: whether each joint's encoder step is known (the default).
    given: prior knowledge, with which the estimate is compared.

    Raises ConfigError, EstimationError.
    """
    refused = [option for option in NOT_HERE if getattr(wanted, option)]
    if refused:
        raise ConfigError(f"model.{refused[0]} needs a settled period: remove it for unsettled data.")
    began = time.perf_counter()
    start = _start(recordings)
    estimate, choice, held_out = _fitted(recordings, wanted, start, segment, zeros)
    estimate = _with_late_back_emf(considered(recordings, estimate), given.brakes)
    predicted = predicted_positions(recordings, estimate)
    plain = estimate if choice is None else choice.plain
    fitted = Fitted(recordings, given.names, predicted, plain, estimate, gravity, given.repeats)
    why = () if given.jumps else causes(fitted)
    found = doubts_of(recordings, estimate, are_known(fitted, why), gravity > 0.0, zeros and not given.zeros)
    verdict = _judged(fitted, given, why, held_out, found)
    result = _result(estimate, recordings, shown_path, round(time.perf_counter() - began, 3), stepped)
    result = replace(
        result,
        validation=Validation(
            held_out_rms=None if held_out is None else tuple(held_out.tolist()),
            residual_over_floor=tuple(estimate.residual_over_noise.tolist()),
        ),
        verdict=describe_verdict(verdict),
        warnings=(*given.jumps, *found.faults, *found.doubts, *found.warnings),
        model_choice=None if choice is None else describe_segment_choice(choice),
    )
    log.info("%s: %s, trust this model: %s", shown_path, result.method, verdict.trust)
    for warning in result.warnings:
        log.warning("%s: %s", shown_path, warning)
    return Estimated(result, predicted, estimate)


def _with_late_back_emf(estimate: ShootingEstimate, brakes: Sequence[float | None]) -> ShootingEstimate:
    """Widen the standard errors of inertias that appear too small because a voltage-driven motor's current lags.

    The back-EMF of such a motor brakes its joint slightly late, so the inertia appears smaller by the viscous friction
    due to back-EMF times the lag. A recording does not state the lag and hardly reveals it.
    """
    covariance = estimate.covariance.copy()
    for joint, brake in enumerate(brakes):
        viscous = max(estimate.parameters[f"viscous_{joint + 1}"], 0.0)
        place = estimate.names.index(CONSTANTS[OWN_INERTIA[joint]])
        covariance[place, place] += (LAG_S * (viscous if brake is None else brake)) ** 2
    return replace(estimate, covariance=covariance)


def _judged(fitted: Fitted, given: Given, why: tuple[str, ...], held_out: Array | None, found: Doubts) -> Verdict:
    """The verdict. why: sentences about defects of the recordings."""
    recordings, estimate = fitted.recordings, fitted.estimate
    conflicts_found, joints = conflicts_in(estimate, given), joint_names(recordings[0].joints)
    ratios = ratios_of(estimate.names, estimate.value, estimate.std)
    spoiled = bool(given.jumps or why)
    contradictory = (
        () if why else contradictions(joints, ratios, given.torque_scale_std, given.torque_source, conflicts_found)
    )
    scales = () if spoiled else angle_scale(recordings, estimate, given.origin)
    lengths = () if spoiled else wrong_length(given.length, fitted.gravity, estimate)
    odd = (*why, *scales, *contradictory, *lengths, *implausible(recordings, estimate, fitted.gravity, given.origin))
    return judge_segments(
        recordings,
        estimate,
        SegmentEvidence(
            held_out,
            () if spoiled else missing_terms(recordings, estimate),
            (*((JUMPED,) if given.jumps else ()), *odd),
            bool(found.faults),
            bool(found.doubts),
            conflicts_found,
            tuple(undetermined(recordings, estimate)),
            spoiled,
            () if why else ratios_said(joints, ratios, given.torque_source, contradictory),
            fitted.gravity > 0.0,
            found.reason,
        ),
    )


def conflicts_in(estimate: ShootingEstimate, given: Given) -> tuple[Conflict, ...]:
    """Estimated values that contradict prior knowledge."""
    names, value, std = [*estimate.names], [*estimate.value], [*estimate.std]
    if given.zeros:
        for zero, error in zip(estimate.zeros, estimate.zeros_std, strict=True):
            names += [f"zero_{joint}" for joint in range(1, zero.size + 1)]
            value, std = [*value, *zero], [*std, *error]
    return conflicts(names, np.array(value), np.array(std), given.torque_scale_std)


def joint_names(count: int) -> tuple[str, ...]:
    """Names of `count` joints for use in sentences."""
    return tuple(f"joint {joint}" for joint in range(1, count + 1))


def _start(recordings: Sequence[Recording]) -> Array:
    """Base parameters from inverse dynamics, with as little filtering as the recordings' rate and length allow."""
    for cutoff in START_CUTOFFS[:-1]:
        try:
            return fit_inverse_dynamics(recordings, cutoff, START_WIDTH).value
        except RecordingError:
            continue
    return fit_inverse_dynamics(recordings, START_CUTOFFS[-1], START_WIDTH).value


def _fitted(
    recordings: Sequence[Recording], wanted: ModelConfig, start: Array, segment: float, zeros: bool
) -> tuple[ShootingEstimate, SegmentChoice | None, Array | None]:
    if wanted.friction == "auto":
        choice = choose_by_shooting(
            recordings, wanted.drive, start, length=segment, zeros=zeros, torque_scale=wanted.torque_scale
        )
        return choice.estimate, choice, choice.chosen.held_out
    # Here each recording has its own encoder zeros.
    model = wanted_model(wanted, recordings[0].joints).without("zeros")
    estimate = estimate_by_shooting(recordings, model, start, length=segment, zeros=zeros)
    return estimate, None, held_out_error(recordings, estimate, start)


def _result(
    estimate: ShootingEstimate,
    recordings: Sequence[Recording],
    shown_path: str,
    seconds: float,
    stepped: Sequence[bool],
) -> ShootingResult:
    base = len(estimate.model.base_names)
    entries = [
        (name, Quantity(float(value), float(std), unit))
        for name, value, std, unit in zip(estimate.names, estimate.value, estimate.std, estimate.units, strict=True)
    ]
    steps = np.max([recording.position_step for recording in recordings], axis=0)
    in_steps = tuple((estimate.residual_rms / steps).tolist()) if all(stepped) else ()
    zeros = tuple(
        Zeros(zero=tuple(zero.tolist()), std=tuple(std.tolist()))
        for zero, std in zip(estimate.zeros, estimate.zeros_std, strict=True)
    )
    return ShootingResult(
        method=f"multiple shooting: {estimate.segments} segments of {estimate.segment_length:g} s with unknown "
        f"initial states; {estimate.model.description}; standard errors robust to model error",
        config=shown_path,
        joints=estimate.model.joints,
        parameters=dict(entries[:base]),
        extra=dict(entries[base:]),
        covariance=Covariance(tuple(estimate.names), tuple(map(tuple, estimate.covariance.tolist()))),
        fit=ShootingFit(
            residual_rms_rad=tuple(estimate.residual_rms.tolist()),
            residual_rms_ticks=in_steps,
            samples=int(sum(recording.time.size for recording in recordings)),
            segments=estimate.segments,
        ),
        timing=Timing(estimation_seconds=seconds),
        zeros=zeros or None,
    )
