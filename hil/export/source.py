"""The input of all exporters, read once: the arm of a run folder, or its recording."""

import json
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil import strict_json
from hil.arm_model import ArmModel
from hil.config.schema import Config
from hil.errors import ExportError, RunFolderError
from hil.model_file import model_of, read_usable_result
from hil.results.result import Result
from hil.runs.run_folder import RunFolder

__all__ = ["MissingPackages", "Recorded", "Source"]


class MissingPackages(ExportError):
    """Packages needed for some formats are not installed. needs: one clause per format that names its package."""

    def __init__(self, *needs: str) -> None:
        super().__init__(f"{', '.join(needs)}: pip install 'hil[export]'.")
        self.needs = needs


@dataclass(frozen=True)
class Source:
    """A run with a result. link_length: length of link 1 [m] if the parameters do not determine it."""

    run: Path
    result: Result
    model: ArmModel
    link_length: float | None = None

    @classmethod
    def open(cls, run: Path, link_length: float | None = None) -> "Source":
        """Read a run folder; raises ResultError."""
        result = read_usable_result(run)
        return cls(run, result, model_of(result, run), link_length)


@dataclass(frozen=True)
class Recorded:
    """A recording, with or without an estimate.

    joints: names of the joints. result: the estimate from the recording; None if there is none.
    """

    run: Path
    joints: tuple[str, ...]
    result: Result | None

    @classmethod
    def open(cls, run: Path) -> "Recorded":
        """Read a run folder; raises RunFolderError, and ResultError for a damaged result."""
        from hil.runs.recording_folder import is_recording_folder

        if is_recording_folder(run):
            raise RunFolderError(
                f"{run} is an estimate from another tool's recording: the samples are in that tool's files. Export the "
                "arm instead: urdf, mjcf, toml or json."
            )
        folder = RunFolder.open(run)
        result = read_usable_result(run) if (folder.path / "result.json").is_file() else None
        return cls(folder.path, tuple(joint.name for joint in folder.load_config().joints), result)

    @property
    def result_json(self) -> str:
        """The result as JSON; an empty object if there is none."""
        return strict_json.dumps({} if self.result is None else self.result.to_json(), indent=2)

    @cached_property
    def samples(self) -> NDArray[np.void]:
        """The recording's rows (hil.runs.recording.sample_type). Raises RunFolderError."""
        from hil.runs.recording import load_samples

        return load_samples(self.run / "samples.npy", len(self.joints))

    @cached_property
    def config(self) -> Config:
        """The configuration of the run. Raises RunFolderError, ConfigError."""
        return RunFolder.open(self.run).load_config()

    @cached_property
    def started(self) -> float:
        """When the run was started [s since 1970]. Raises RunFolderError."""
        path = self.run / "run.json"
        try:
            return datetime.fromisoformat(json.loads(path.read_text(encoding="utf-8"))["started"]).timestamp()
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{path} cannot be read: {error!r}.") from error
