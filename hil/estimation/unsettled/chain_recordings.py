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
from hil.errors import ConfigError, CsvError
from hil.estimation.chain_estimate import chain_facts
from hil.estimation.slips.sticking import sticking_joints
from hil.estimation.torque_constants import contradictions, ratios_of
from hil.estimation.unsettled.chain_changes import changed_columns
from hil.estimation.unsettled.chain_slips import late_torque, refuse_chain_slips, torques_apart
from hil.estimation.unsettled.chain_verdict import FITTED_SHARES, chain_verdict
from hil.estimator.arrays import Array
from hil.estimator.chain.column_faults import ColumnCheck
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel, Drive
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.mount import better_gravity_recorded
from hil.estimator.chain.recordings import MotionPiece, RecordedChain, identify_recordings, torque_error
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError, StandstillError
from hil.results.parts import Covariance, Quantity, ShootingFit, Timing, Validation
from hil.results.result import ShootingResult

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
    changed = changed_columns(check, arm, config.columns)
    if changed is None:
        refuse_chain_slips(check, config.joint_names or (), source, mounted)
    elif changed.is_useless:
        raise CsvError(f"{source}: {changed.refusal}")
    names = [joint.name for joint in arm.joints]
    is_sound = changed is None  # as given, wrong columns would seem late, and of the wrong scale
    late = late_torque(check, names, all(each.between == "held" for each in recordings)) if is_sound else ()
    contradictory = () if model.torque_scale or late or not is_sound else torques_apart(check, names)
    found = _identified(recordings, model, prior, bool(contradictory))
    model = found.model
    foretold, fitted_share = _held_out(recordings, model, prior)
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
        verdict=chain_verdict(
            found,
            arm,
            foretold,
            prior,
            contradictory,
            late,
            _sticking(recordings),
            None if mounted is None or changed is not None else mounted.gravity,
            changed,
            fitted_share,
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


def _held_out(recordings: Sequence[Recording], model: ChainModel, prior: Prior) -> tuple[Array | None, float]:
    """Return the relative torque error on the last part of each recording, with parameters fitted to the rest, and the
    fraction that was fitted.

    The error is None if a part is too short or a joint stands still in it, whichever fraction is fitted.
    """
    for share in FITTED_SHARES:
        try:
            first = [_part(each, 0.0, share) for each in recordings]
            last = [_part(each, share, 1.0) for each in recordings]
            error = torque_error(last, identify_recordings(first, model, prior))
        except StandstillError:
            continue
        except EstimationError:
            break
        if not np.all(np.isnan(error)):
            return error, share
    return None, FITTED_SHARES[0]


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


def _predicted(recordings: Sequence[Recording], found: RecordedChain) -> tuple[Array, ...]:
    if not found.simulated:
        return tuple(np.full_like(each.position, np.nan) for each in recordings)
    predicted = []
    for recording, position in zip(recordings, found.positions, strict=True):
        at = recording.time[0] + np.arange(position.shape[1]) / MotionPiece.of(recording).rate
        predicted.append(np.stack([np.interp(recording.time, at, row) for row in position]))
    return tuple(predicted)
