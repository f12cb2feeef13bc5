"""The folder of an estimate from other tools' recordings: the data exactly as used, and the result.

config.toml      the configuration: a copy of the one given, with [columns] as interpreted
run.json         the files with their SHA-256, versions and machine, notes
recordings.npz   each recording in SI units, with what the model predicts
result.json, report.html
"""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from hil import __version__
from hil.errors import RunFolderError, not_written
from hil.estimator.arrays import Array
from hil.results.json_form import FormError, from_json, to_json
from hil.runs.file_size import check_archive
from hil.runs.run_folder import SCHEMA, taken, write_json

KIND = "recordings"
ARRAYS = "recordings.npz"
_PACKAGES = ("numpy", "scipy", "numba")


@dataclass(frozen=True)
class RecordingFile:
    """A file that was read. sha256: SHA-256 of its contents; empty for a folder."""

    path: str
    sha256: str


@dataclass(frozen=True)
class RecordingRecord:
    """The contents of run.json.

    config: path of the configuration; empty if there is none. started: ISO 8601. notes: sentences.
    """

    config: str
    started: str
    files: tuple[RecordingFile, ...]
    notes: tuple[str, ...]
    versions: Mapping[str, str]
    python: str
    machine: str
    kind: str = KIND


@dataclass(frozen=True)
class Predicted:
    """One recording as it was used for the estimate. time: sampling times (samples,) [s]. torque, position, predicted:
    (joints, samples) [N m, rad].

    predicted: prediction of the fitted model, segment by segment, each from its estimated state; NaN where nothing was
    simulated.
    """

    name: str
    time: Array
    torque: Array
    position: Array
    predicted: Array


def describe(config: str, files: Sequence[Path], notes: Sequence[str]) -> RecordingRecord:
    """Return the contents of run.json for an estimate made now."""
    return RecordingRecord(
        config,
        datetime.now().astimezone().isoformat(timespec="seconds"),
        tuple(RecordingFile(str(path), _sha256(path)) for path in files),
        tuple(notes),
        {"hil": __version__, **{name: version(name) for name in _PACKAGES}},
        platform.python_version(),
        platform.platform(),
    )


def is_recording_folder(path: Path) -> bool:
    """Whether `path` was made by `create`."""
    return (path / ARRAYS).is_file() and (path / "run.json").is_file()


def create(path: Path) -> None:
    """Make the folder; raises RunFolderError if it is not empty or not writable."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise taken(path)
    except OSError as error:
        raise not_written(path, error, "Run folder") from error


def save(path: Path, record: RecordingRecord, config: str, recordings: Sequence[Predicted]) -> None:
    """Write all files except the result and the report; raises RunFolderError."""
    arrays = {
        f"{number}_{name}": getattr(each, name)
        for number, each in enumerate(recordings)
        for name in ("time", "torque", "position", "predicted")
    }
    try:
        np.savez_compressed(path / ARRAYS, names=np.array([each.name for each in recordings]), **arrays)
        (path / "config.toml").write_text(config, encoding="utf-8")
    except OSError as error:
        raise not_written(path, error) from error
    write_json(path / "run.json", {"schema": SCHEMA, **to_json(record)})


def load_record(path: Path) -> RecordingRecord:
    """Load run.json of a folder; raises RunFolderError."""
    file = path / "run.json"
    try:
        return from_json(RecordingRecord, json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, FormError) as error:
        raise RunFolderError(f"{file} cannot be read: {error}.") from error


def load_recordings(path: Path) -> tuple[Predicted, ...]:
    """Load the recordings of a folder; raises RunFolderError."""
    try:
        check_archive(path / ARRAYS)
        with np.load(path / ARRAYS, allow_pickle=False) as kept:
            names = kept["names"].tolist()
            return tuple(
                Predicted(str(name), *(kept[f"{k}_{part}"] for part in ("time", "torque", "position", "predicted")))
                for k, name in enumerate(names)
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise RunFolderError(f"{path / ARRAYS} cannot be read: {error}.") from error


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
