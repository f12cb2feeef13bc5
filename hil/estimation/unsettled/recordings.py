"""Estimates from other tools' files; the results are stored in folders like those of runs."""

import json
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from hil.arm_model import UNKNOWN_SERVO, JointFacts
from hil.config.csv_columns import Columns
from hil.config.recording import RecordingConfig, load_recording_config
from hil.errors import ConfigError, CsvError
from hil.estimation.physical import physical_of
from hil.estimation.plausibility import link_length
from hil.estimation.slips.recorded_jumps import jump_sentences
from hil.estimation.unsettled.chain_recordings import estimate_chain_recordings
from hil.estimation.unsettled.estimate import Estimated, Given, estimate_any
from hil.estimation.unsettled.slips import refuse_slips, refuse_stuck
from hil.estimator.arrays import Array
from hil.estimator.baselines.zero import turned_zeros
from hil.estimator.data.recording import Recording
from hil.estimator.errors import ConvergenceError, RecordingError
from hil.recordings.convert import Converted, convert
from hil.recordings.files import read_tables
from hil.recordings.periodic import mean_period
from hil.recordings.units import split_head
from hil.results.parts import ArmFacts
from hil.results.result import ShootingResult
from hil.runs.recording_folder import Predicted, describe, save
from hil.runs.run_folder import write_json

MOST_RECORDINGS = 200


def estimate_recordings(paths: Sequence[Path], config_path: Path | None, folder: Path | None) -> ShootingResult:
    """Return the result of one or more separate recordings of the same arm, and write it into `folder`, which must
    exist.

    Raises HilError, EstimationError.
    """
    config = RecordingConfig() if config_path is None else load_recording_config(config_path)
    try:
        return (_estimate_planar if config.arm.urdf is None else _estimate_chain)(paths, config_path, config, folder)
    except RecordingError as error:
        raise CsvError(f"{', '.join(map(str, paths))}: {error}.") from error
    except ConvergenceError as error:
        raise ConvergenceError(f"{', '.join(map(str, paths))}: {error}") from error


def _estimate_planar(
    paths: Sequence[Path], config_path: Path | None, config: RecordingConfig, folder: Path | None
) -> ShootingResult:
    whole = _zeroed(_read(paths, config.columns), config.arm.gravity)
    read = _averaged(whole)
    columns, gravity = read.columns, config.arm.gravity
    zeros = (columns.zeros_unknown or config.model.zeros) and gravity > 0.0
    shown = ", ".join(map(str, paths)) if config_path is None else str(config_path)
    lengths, joints = config.arm.link_lengths, read.recordings[0].joints
    if lengths is not None and len(lengths) != joints:
        raise ConfigError(f"{shown}: arm.link_lengths: give one length per position column ({joints}).")
    refuse_stuck(read.recordings, ", ".join(map(str, paths)), columns.segment)
    zero_is_set = config.columns.zero is not None
    refuse_slips(read.recordings, ", ".join(map(str, paths)), columns.zero, zero_is_set)
    jumps = jump_sentences(whole.recordings, whole.names, whole.stepped)
    repeats = all(one is not mean for one, mean in zip(whole.recordings, read.recordings, strict=True))
    length = link_length(config.known, config.arm)
    origin, brakes = tuple(columns.zero or ()), _brakes(columns)
    given = Given(names=read.names, jumps=jumps, origin=origin, repeats=repeats, length=length, brakes=brakes)
    found = estimate_any(read.recordings, config.model, columns.segment, zeros, shown, gravity, read.stepped, given)
    result = _doubted(_named(found, read, config), read)
    if config.known is not None:
        result = replace(result, physical=physical_of(result, config.known.quantities(), gravity))
    if folder is not None:
        _keep(folder, paths, config_path, config, read, found.predicted)
        write_json(folder / "result.json", result.to_json())
    return result


def _estimate_chain(
    paths: Sequence[Path], config_path: Path | None, config: RecordingConfig, folder: Path | None
) -> ShootingResult:
    """The result for a spatial arm; its URDF is kept next to the result."""
    read = _read(paths, config.columns)
    shown = ", ".join(map(str, paths)) if config_path is None else str(config_path)
    as_read = config.model_copy(update={"columns": read.columns})
    found = estimate_chain_recordings(read.recordings, as_read, shown, ", ".join(map(str, paths)))
    arm = _arm(read, config)
    assert config.arm.urdf is not None  # checked by the estimate
    jumps = jump_sentences(read.recordings, read.names, read.stepped, tuple(joint.name for joint in arm.joints))
    warnings = (*jumps, *found.result.warnings)
    result = replace(found.result, recordings=read.names, arm=arm, notes=read.notes, warnings=warnings)
    result = _doubted(result, read)
    if folder is not None:
        _keep(folder, paths, config_path, config, read, found.predicted)
        urdf = Path(config.arm.urdf)
        if not (folder / urdf.name).exists():
            shutil.copyfile(urdf, folder / urdf.name)
        write_json(folder / "result.json", result.to_json())
    return result


def _read(paths: Sequence[Path], columns: Columns) -> Converted:
    found = [convert(table, columns) for path in paths for table in read_tables(path)]
    if len({len(each.columns.position or ()) for each in found}) > 1:
        raise ConfigError("The files have different numbers of joints: give recordings of one arm.")
    recordings = tuple(recording for each in found for recording in each.recordings)
    if len(recordings) > MOST_RECORDINGS:
        raise CsvError(f"{len(recordings)} recordings, more than {MOST_RECORDINGS}: give fewer files or episodes.")
    names = tuple(name for each in found for name in each.names)
    _refuse_twice(recordings, names)
    stepped = tuple(bool(all(flags)) for flags in zip(*(each.stepped for each in found), strict=True))
    notes, doubts = _once(each.notes for each in found), _once(each.doubts for each in found)
    unusable = any(each.unusable for each in found)
    return Converted(_stepped_alike(recordings, found), names, stepped, found[0].columns, notes, doubts, unusable)


def _refuse_twice(recordings: Sequence[Recording], names: Sequence[str]) -> None:
    """Raise CsvError for a recording that is given twice: the same noise, counted twice, would halve the variances."""
    for (first, one), (second, other) in combinations(zip(names, recordings, strict=True), 2):
        same = np.array_equal(one.position, other.position, equal_nan=True)
        if same and np.array_equal(one.torque, other.torque, equal_nan=True):
            raise CsvError(f"{first} and {second} hold the same samples: give each recording once.")


def _stepped_alike(recordings: tuple[Recording, ...], found: Sequence[Converted]) -> tuple[Recording, ...]:
    """Use one encoder step for all recordings of an arm: the smallest that any of them shows."""
    if len(found) == 1:
        return recordings
    step = np.min([each.position_step for each in recordings], axis=0)
    return tuple(replace(each, position_step=step) for each in recordings)


def _once(sentences: Iterable[Sequence[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(each for some in sentences for each in some))


def _doubted(result: ShootingResult, read: Converted) -> ShootingResult:
    """The result, with doubts about the columns added to its verdict."""
    verdict = result.verdict
    if not read.doubts or verdict is None:
        return result
    trust = "no" if read.unusable or verdict.trust == "no" else "with care"
    return replace(result, verdict=replace(verdict, trust=trust, sentences=(*verdict.sentences, *read.doubts)))


def _zeroed(read: Converted, gravity: float) -> Converted:
    """Measure angles from the horizontal if their origin is not given but can be determined from gravity."""
    if gravity <= 0.0 or read.columns.zero is not None:
        return read
    zeros = turned_zeros(read.recordings)
    if zeros is None:
        return read
    quarter = np.pi / 2.0
    whole = np.round(zeros / quarter) * quarter
    zeros = np.where(np.abs(zeros - whole) < 0.2, whole, zeros)
    moved = tuple(replace(each, position=each.position + zeros[:, None]) for each in read.recordings)
    listed = ", ".join(f"{zero:.4g}" for zero in zeros)
    said = (
        f"The torque of gravity shows that joint 1 is not measured from the horizontal: zero = [{listed}] rad was "
        "added. If that is wrong, set columns.zero."
    )
    columns = read.columns.model_copy(update={"zero": zeros.tolist()})
    return replace(read, recordings=moved, columns=columns, notes=(*read.notes, said))


def _averaged(read: Converted) -> Converted:
    recordings, notes = [], list(read.notes)
    for name, recording in zip(read.names, read.recordings, strict=True):
        mean = mean_period(recording) if read.columns.between == "held" else None
        recordings.append(recording if mean is None else mean.recording)
        if mean is not None:
            notes.append(
                f"{name}: periodic; the mean of {mean.periods} settled periods of {mean.seconds:g} s was used."
            )
    return replace(read, recordings=tuple(recordings), notes=tuple(notes))


def _named(found: Estimated, read: Converted, config: RecordingConfig) -> ShootingResult:
    result = found.result
    zeros = result.zeros
    if zeros is not None:
        zeros = tuple(replace(zero, recording=name) for name, zero in zip(read.names, zeros, strict=True))
    arm = _arm(read, config)
    notes = [*read.notes, *_back_emf(read.columns, result)]
    return replace(result, recordings=read.names, zeros=zeros, arm=arm, notes=tuple(notes))


def _brakes(columns: Columns) -> tuple[float | None, ...]:
    """Return the viscous friction due to each joint's back-EMF [N m s/rad], with None where the torque constant is
    not known. The tuple is empty if the joints are not driven by voltage.
    """
    gains, constants = columns.gains, columns.torque_constant
    if columns.drive not in {"voltage", "pwm"} or gains is None:
        return ()
    if constants is None:
        return (None,) * len(gains)
    return tuple(gain * constant for gain, constant in zip(gains, constants, strict=True))


def _back_emf(columns: Columns, result: ShootingResult) -> list[str]:
    """State how much of the viscous friction of voltage-driven joints is due to back-EMF."""
    brakes = _brakes(columns)
    if not brakes:
        return []
    if columns.torque_constant is None:
        return ["The joints are driven by voltage, so viscous friction includes braking by back-EMF."]
    parts = [
        f"{brake:.3g} of {result.parameters[f'viscous_{joint}'].value:.3g} N m s/rad in joint {joint}"
        for joint, brake in enumerate(brakes, 1)
    ]
    return [f"The joints are driven by voltage, so viscous friction includes braking by back-EMF: {', '.join(parts)}."]


def _arm(read: Converted, config: RecordingConfig) -> ArmFacts:
    """Describe the joints from the recordings; the limits are the observed extremes."""
    columns = read.columns
    gains, names = columns.gains or [1.0] * len(columns.position or ()), config.joint_names
    named = names if names is not None and len(names) == len(gains) else _joint_names(columns.position or ())
    joints = []
    for joint, (name, gain) in enumerate(zip(named, gains, strict=True)):
        position = np.concatenate([each.position[joint] for each in read.recordings])
        speed = np.concatenate([np.diff(each.filled()[joint]) / np.diff(each.time) for each in read.recordings])
        goal = max(float(np.abs(each.torque[joint]).max()) for each in read.recordings) / gain
        joints.append(
            JointFacts(
                name,
                UNKNOWN_SERVO,
                "pwm" if columns.drive in {"voltage", "pwm"} else "current",
                gain,
                0.0,
                goal,
                (float(np.nanmin(position)), float(np.nanmax(position))),
                float(np.percentile(np.abs(speed), 99.9)),
            )
        )
    rest = read.recordings[0].filled()[:, 0]
    return ArmFacts(config.arm.gravity, tuple(rest.tolist()), tuple(joints))


def _joint_names(columns: Sequence[str]) -> Sequence[str]:
    """Joint names from the column names; numbers if there are none."""
    last = [re.split(r"[./]", split_head(name)[0])[-1] for name in columns]
    named = len(set(last)) == len(last) and not any(re.search(r"\d", name) for name in last) and len(last) > 1
    return last if named else [f"joint_{number}" for number in range(1, len(columns) + 1)]


def _keep(
    folder: Path,
    paths: Sequence[Path],
    config_path: Path | None,
    config: RecordingConfig,
    read: Converted,
    predicted: Sequence[Array],
) -> None:
    kept = [
        Predicted(name, each.time, each.torque, each.position, motion)
        for name, each, motion in zip(read.names, read.recordings, predicted, strict=True)
    ]
    text = _as_toml(config, read.columns) if config_path is None else config_path.read_text(encoding="utf-8-sig")
    save(folder, describe("" if config_path is None else str(config_path), paths, read.notes), text, kept)


def _as_toml(config: RecordingConfig, columns: Columns) -> str:
    """A configuration that reproduces the result from the same files."""
    lines = [
        "# How `hil estimate` interpreted the columns.",
        "[arm]",
        f"gravity = {config.arm.gravity!r}",
        "",
        "[columns]",
    ]
    given = columns.model_dump(exclude_none=True)
    return "\n".join([*lines, *(f"{key} = {json.dumps(value)}" for key, value in given.items())]) + "\n"
