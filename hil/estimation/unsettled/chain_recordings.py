"""Estimates of spatial arms from other tools' recordings; the last part of each recording serves as a check."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hil.config.chain import doubted_inertias
from hil.config.recording import RecordingConfig
from hil.description.arm import ArmDescription, ArmFileError
from hil.description.files import read_arm
from hil.description.urdf import rotation_of
from hil.errors import ConfigError
from hil.estimation.chain_estimate import chain_facts, stopped_short, vague
from hil.estimation.chain_mount import MountDoubt, mass_on_the_other_side, mounted_otherwise
from hil.estimation.slips.sticking import sticking_joints
from hil.estimation.torque_constants import contradictions, ratios_of, ratios_said
from hil.estimation.unsettled.chain_slips import late_torque, refuse_chain_slips, torques_apart
from hil.estimator.arrays import Array
from hil.estimator.chain.column_faults import ColumnCheck
from hil.estimator.chain.identify import SYSTEMATIC
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel, Drive
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.mount import LIKELY, SURE, better_gravity_recorded, opposed_moments
from hil.estimator.chain.recordings import MotionPiece, RecordedChain, identify_recordings, torque_error
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError
from hil.estimator.models.bounds import bound_sentence
from hil.estimator.models.conflicts import Trust, conflict_sentences, contradicted, lowered
from hil.results.parts import Covariance, Quantity, ShootingFit, Timing, Validation, Verdict
from hil.results.result import ShootingResult

FITTED_SHARE = 0.75  # fraction of each recording that is fitted; the rest serves as a check
EXPLAINED = 1.2  # ratio of residual to noise up to which the model counts as complete
TORQUE_FORETOLD, TORQUE_WRONG = 0.1, 0.3  # relative torque error on the last part: limits for yes and no
TORQUE_UNEXPLAINED = 0.1  # limit for rejecting a model that leaves part of the motion unexplained
UNSUPPORTED = ("presliding", "asymmetry", "ripple", "cogging", "saturation", "cable", "encoder")


@dataclass(frozen=True)
class ChainEstimated:
    """An estimate from recordings. result: complete except for the fields that the caller fills in. predicted:
    positions per recording (joints, samples) [rad]; NaN if there are none.
    """

    result: ShootingResult
    predicted: tuple[Array, ...]


def estimate_chain_recordings(
    recordings: Sequence[Recording], config: RecordingConfig, shown_path: str, source: str
) -> ChainEstimated:
    """Estimate a spatial arm from recordings. source: names of their files, for messages.

    Raises ConfigError, CsvError, ArmFileError, EstimationError.
    """
    refused = [option for option in UNSUPPORTED if getattr(config.model, option)]
    if refused:
        raise ConfigError(
            f"{shown_path}: model.{refused[0]} = true: only planar arms support this term so far; remove it. Spatial "
            'arms support friction = "coulomb", "stribeck", "stribeck_load" or "auto", zeros, torque_scale and '
            "base_tilt."
        )
    began = time.perf_counter()
    arm = _described(config, recordings[0].joints, shown_path)
    gravity = rotation_of(*config.arm.base).T @ np.array([0.0, 0.0, -config.arm.gravity])
    base = BaseParameters.of(Chain(*arm.geometry, gravity), tilts=config.model.base_tilt)
    prior = Prior.of(base, arm.parameters)
    wanted = config.model
    drive = _drive(config, base.chain.joints)
    model = ChainModel(
        *(base, wanted.fixed_friction, drive, wanted.zeros, wanted.torque_scale and base.chain.joints > 1),
        base_tilt=wanted.base_tilt,
        lags=base.chain.joints > 1,
        by_voltage=tuple(range(1, base.chain.joints + 1)) if config.columns.drive in {"voltage", "pwm"} else (),
    )
    check = ColumnCheck.of(recordings, ChainModel(base), prior)
    mounted = better_gravity_recorded(recordings, model, arm.parameters)
    refuse_chain_slips(check, config.joint_names or (), source, mounted)
    names = [joint.name for joint in arm.joints]
    late = late_torque(check, names, all(each.between == "held" for each in recordings))
    contradictory = () if model.torque_scale or late else torques_apart(check, names)
    found = _identified(recordings, model, prior, bool(contradictory))
    model = found.model
    foretold = _held_out(recordings, model, prior)
    linear = len(model.linear_names)
    entries = {
        name: Quantity(float(value), float(std), unit)
        for name, value, std, unit in zip(found.names, found.value, found.std, found.units, strict=True)
    }
    steps = np.max([each.position_step for each in recordings], axis=0)
    result = ShootingResult(
        method=_method(found),
        config=shown_path,
        joints=model.joints,
        parameters=dict(list(entries.items())[:linear]),
        extra=dict(list(entries.items())[linear:]),
        covariance=Covariance(found.names, tuple(map(tuple, found.covariance.tolist()))),
        fit=ShootingFit(
            residual_rms_rad=tuple(found.residual.tolist()),
            residual_rms_ticks=tuple((found.residual / steps).tolist()),
            samples=int(sum(each.time.size for each in recordings)),
            segments=len(recordings),
        ),
        validation=Validation(
            residual_over_floor=tuple(found.residual_over_noise.tolist()) if found.simulated else None
        ),
        verdict=_verdict(
            found,
            arm,
            foretold,
            prior,
            contradictory,
            late,
            _sticking(recordings),
            None if mounted is None else mounted.gravity,
        ),
        warnings=doubted_inertias(arm),
        timing=Timing(estimation_seconds=round(time.perf_counter() - began, 3)),
        chain=chain_facts(arm, base, found.from_prior),
    )
    return ChainEstimated(result, _predicted(recordings, found))


def _drive(config: RecordingConfig, joints: int) -> Drive:
    """The configured drive model. The default for several joints is a common delay and a separate lag for each joint.

    Other tools' recordings may contain both, and a delay does not explain lags that differ between joints.
    """
    is_given = "model" in config.model_fields_set and "drive" in config.model.model_fields_set
    return config.model.drive if is_given or joints == 1 else "delay_lag"


def _described(config: RecordingConfig, joints: int, shown: str) -> ArmDescription:
    assert config.arm.urdf is not None  # ensured by the caller
    names = config.joint_names
    if names is None:
        raise ConfigError(
            f"{config.arm.urdf} describes the arm, but its joints are not named: for each column in "
            "columns.position, add a [[joints]] table with that joint's name, in order from the base outwards."
        )
    if len(names) != joints:
        raise ConfigError(
            f"{shown}: {len(names)} [[joints]] tables, but {joints} position columns: give one per joint."
        )
    try:
        return read_arm(Path(config.arm.urdf), names)
    except ArmFileError as error:
        raise ConfigError(f"{shown}: arm.urdf: {error}") from error


def _identified(recordings: Sequence[Recording], model: ChainModel, prior: Prior, contradictory: bool) -> RecordedChain:
    """Fit the model to the recordings. contradictory: whether the torques seem to contradict each other.

    If so, and if torques are held between samples, the ratios of the torques are fitted too. If that fit shows that the
    torques agree after all, the model is fitted again without the ratios.
    """
    if contradictory and all(each.between == "held" for each in recordings):
        found = identify_recordings(recordings, replace(model, torque_scale=True), prior)
        if contradictions([""] * model.joints, ratios_of(found.names, found.value, found.std), {}, "column"):
            return found
    return identify_recordings(recordings, model, prior)


def _sticking(recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Return the joints, numbered from 0, that stick in any of the recordings."""
    found = set()
    for each in recordings:
        rate = (each.time.size - 1) / (each.time[-1] - each.time[0])
        found |= set(sticking_joints(each.position, float(rate), each.position_step))
    return tuple(sorted(found))


def _held_out(recordings: Sequence[Recording], model: ChainModel, prior: Prior) -> Array | None:
    """Return the relative torque error on the last part of each recording, with parameters fitted to the rest.

    Returns None if a part is too short or the arm stands still in it.
    """
    try:
        first = [_part(each, 0.0, FITTED_SHARE) for each in recordings]
        last = [_part(each, FITTED_SHARE, 1.0) for each in recordings]
        error = torque_error(last, identify_recordings(first, model, prior))
    except EstimationError:
        return None
    return None if np.all(np.isnan(error)) else error


def _part(recording: Recording, start: float, end: float) -> Recording:
    some = slice(int(start * recording.time.size), int(end * recording.time.size))
    return Recording(
        recording.time[some],
        recording.torque[:, some],
        recording.position[:, some],
        recording.position_step,
        recording.between,
        recording.command_to_sample,
    )


def _method(found: RecordedChain) -> str:
    if found.simulated:
        return (
            f"filtered inverse dynamics ({found.cutoff:g} Hz), then maximum likelihood of one-step-ahead position "
            f"predictions with an observer; {found.model.description}; arbitrary motion, commanded torque"
        )
    return (
        f"filtered inverse dynamics ({found.cutoff:g} Hz) by weighted least squares: the torque was measured, not "
        f"commanded, so nothing was simulated; viscous and Coulomb friction only"
    )


def _verdict(
    found: RecordedChain,
    arm: ArmDescription,
    foretold: Array | None,
    prior: Prior,
    contradictory: Sequence[str] = (),
    late: Sequence[str] = (),
    sticking: Sequence[int] = (),
    gravity: Array | None = None,
) -> Verdict:
    """The verdict, with reasons.

    contradictory, late: sentences about torques that contradict each other in the regression, or are logged late.
    sticking: joints that stick, from 0. gravity: see `better_gravity_recorded`.
    """
    names = found.model.base.names
    weakest = names[int(np.argmax(found.std[: len(names)] / prior.std))]
    trust: Trust = "yes"
    sentences = []
    # A regression alone does not reveal missing effects.
    explained = not found.simulated or (
        float(found.residual_over_noise.max()) <= EXPLAINED and found.systematic <= SYSTEMATIC
    )
    if found.simulated:
        worst = float(found.residual_over_noise.max())
        joint = arm.joints[int(np.argmax(found.residual_over_noise))].name
        sentences.append(f"The largest residual ({joint}) is {worst:.2f} times the noise of that joint's angle.")
        trust = trust if worst <= EXPLAINED else "with care"
        if found.systematic > SYSTEMATIC:
            trust = "with care"
            sentences.append(
                "Part of the residual repeats with the motion. This increases standard errors by a factor of up to "
                f"{found.systematic:.1f}, and some values may be wrong by more than their standard errors. "
                f"{_missing(found.model, gravity)}"
            )
    else:
        trust = "with care"
        sentences.append(
            "The torque columns were treated as measurements, so the result comes from a regression; its errors are "
            'partly systematic. If the columns hold commands, set columns.between = "held": maximum likelihood is then '
            "far more accurate."
        )
    at_most, why = _judged_prediction(foretold, arm, explained, gravity is not None)
    trust = lowered(trust, at_most)
    sentences += why
    if found.from_prior:
        trust = lowered(trust, "with care")
        sentences.append(
            f"The recordings reveal little about {', '.join(found.from_prior)}: these values come from the URDF."
        )
    if said := vague(prior, names, found.std, found.from_prior):
        trust = lowered(trust, "with care")
        sentences.append(said)
    if found.at_bound:
        trust = lowered(trust, "with care")
        sentences.append(bound_sentence(found.at_bound))
    trust = lowered(trust, contradicted(found.conflicts, explained))
    sentences += conflict_sentences(found.conflicts, explained)
    joints, ratios = [joint.name for joint in arm.joints], ratios_of(found.names, found.value, found.std)
    differ = contradictions(joints, ratios, {}, "column", found.conflicts)
    trust = lowered(trust, "with care" if differ else "")
    sentences += (*differ, *ratios_said(joints, ratios, "column", differ))
    trust = lowered(trust, "with care" if late else "")
    sentences += late
    if contradictory and not found.simulated:
        trust = "no"
        sentences += contradictory
    if not found.reached:
        trust = lowered(trust, "with care")
        names_stuck = [arm.joints[joint].name for joint in sticking]
        sentences.append(stopped_short(names_stuck, "Record faster motion"))
    mount = _doubted_mount(found, arm, prior, gravity, explained)
    if mount is None:
        return Verdict(trust, weakest, tuple(sentences))
    return Verdict(lowered(trust, mount.at_most), weakest, (*sentences, *mount.said), mount.first)


def _doubted_mount(
    found: RecordedChain, arm: ArmDescription, prior: Prior, gravity: Array | None, explained: bool
) -> MountDoubt | None:
    """Return the contradiction between the centres of mass and the description, if there is one."""
    sure = SURE if gravity is None else LIKELY
    opposed = opposed_moments(found.names, found.value, found.std, prior, sure)
    if gravity is None:
        return mass_on_the_other_side(arm, opposed, explained, is_run=False)
    return mounted_otherwise(arm, opposed, found.model.base.chain.gravity, gravity, explained, is_run=False)


def _missing(model: ChainModel, gravity: Array | None) -> str:
    """Say why part of the motion is unexplained. gravity: see `better_gravity_recorded`."""
    if gravity is not None:
        return "The model is incomplete, probably because the arm is not mounted as configured."
    lags = ', lags that differ by joint (model.drive = "delay_lag")' if model.drive == "delay" else ""
    return (
        "An effect is missing from the model: torque ripple or cogging, play or elasticity of the gears, a cable, "
        f"friction that depends on load or changes with time{lags}, or torques that differed from the commands."
    )


def _judged_prediction(
    foretold: Array | None, arm: ArmDescription, explained: bool, is_mount_known: bool = False
) -> tuple[str, tuple[str, ...]]:
    """The best verdict that the prediction of the last part allows ("" for any), and why.

    is_mount_known: whether the verdict names another mount as the cause.
    """
    if foretold is None:
        return "with care", (
            "The recordings are too short, or continue for too long after the motion has ended, to check the "
            "prediction on a part that was not fitted.",
        )
    error, wrong = float(np.nanmax(foretold)), TORQUE_WRONG if explained else TORQUE_UNEXPLAINED
    said = _foretold_said(error, arm.joints[int(np.nanargmax(foretold))].name)
    if error <= wrong:
        return "with care" if error > TORQUE_FORETOLD else "", (said,)
    unexplained = "" if explained else " together with an unexplained part of the motion"
    check = (
        ": check which column belongs to which joint, the units and signs of the columns, whether the load changed, "
        "and the description of the arm"
    )
    check = "" if is_mount_known else check
    return "no", (said, f'An error above {100 * wrong:.0f} %{unexplained} makes the verdict "no"{check}.')


def _foretold_said(error: float, joint: str) -> str:
    """Describe how well the last part is predicted. error: relative to the RMS torque. joint: the joint with it."""
    part = f"the torque in the last {100 * (1 - FITTED_SHARE):.0f} % of each recording"
    if error > 1.0:
        return (
            f"When fitted to the rest, the model cannot predict {part}: the error is {error:.2g} times the "
            f"torque's own RMS (worst joint: {joint})."
        )
    return (
        f"When fitted to the rest, the model predicts {part} to within {100 * error:.1f} % of the torque's RMS (worst "
        f"joint: {joint})."
    )


def _predicted(recordings: Sequence[Recording], found: RecordedChain) -> tuple[Array, ...]:
    if not found.simulated:
        return tuple(np.full_like(each.position, np.nan) for each in recordings)
    predicted = []
    for recording, position in zip(recordings, found.positions, strict=True):
        at = recording.time[0] + np.arange(position.shape[1]) / MotionPiece.of(recording).rate
        predicted.append(np.stack([np.interp(recording.time, at, row) for row in position]))
    return tuple(predicted)
