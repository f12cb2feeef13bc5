"""The export formats by name: the function that writes each, and its default file name."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Generic, TypeVar

from hil.errors import ExportError
from hil.export.chain_links import NOT_EXACT
from hil.export.mcap import export_mcap
from hil.export.mjcf import export_mjcf
from hil.export.parameters import export_json, export_toml
from hil.export.source import Recorded, Source
from hil.export.tables import export_csv, export_mat, export_parquet
from hil.export.urdf import export_urdf
from hil.runs.run_folder import RunFolder

S = TypeVar("S", Source, Recorded)


@dataclass(frozen=True)
class Format(Generic[S]):
    """An export format.

    write: function that writes a file and returns what the format cannot represent. file_name: default name in the run
    folder.
    """

    write: Callable[[S, Path], list[str]]
    file_name: str


FORMATS: Mapping[str, Format[Source]] = MappingProxyType(
    {
        "urdf": Format(export_urdf, "arm.urdf"),
        "mjcf": Format(export_mjcf, "arm.xml"),
        "toml": Format(export_toml, "arm.toml"),
        "json": Format(export_json, "arm.json"),
    }
)
"""Formats for an identified arm."""

RECORDING_FORMATS: Mapping[str, Format[Recorded]] = MappingProxyType(
    {
        "csv": Format(export_csv, "samples.csv"),
        "parquet": Format(export_parquet, "samples.parquet"),
        "mcap": Format(export_mcap, "samples.mcap"),
        "mat": Format(export_mat, "samples.mat"),
    }
)
"""Formats for a recording; they need no estimate."""


@dataclass(frozen=True)
class Written:
    """A file that was written, and what its format cannot represent."""

    format: str
    path: Path
    left_out: list[str]

    @property
    def warning(self) -> str:
        """How the arm in the file differs from the identified one; "" if they are dynamically equivalent."""
        why = next(iter(self.left_out), "")
        if not why.startswith(NOT_EXACT):
            return ""
        return f"the arm in {self.path} is not equivalent to the identified one: {why.removeprefix(NOT_EXACT)}."


def export(run: Path, name: str, out: Path | None = None, link_length: float | None = None) -> Written:
    """Write the run in one format, by default into the run folder. Raises ResultError, ExportError, RunFolderError."""
    if name in RECORDING_FORMATS:
        recording = RECORDING_FORMATS[name]
        path = _not_its_own(run, out, recording.file_name)
        return Written(name, path, recording.write(Recorded.open(run), path))
    if name not in FORMATS:
        raise ExportError(
            f"{name!r} is not a format of hil export. Available: {', '.join((*FORMATS, *RECORDING_FORMATS))}."
            + _each_its_own(name)
        )
    arm = FORMATS[name]
    path = _not_its_own(run, out, arm.file_name)
    return Written(name, path, arm.write(Source.open(run, link_length), path))


def _not_its_own(run: Path, out: Path | None, default: str) -> Path:
    """Return the file to write. Raises ExportError if `out` is one of the run's own files, such as its arm.urdf."""
    path = out or run / default
    if path.parent.resolve() != run.resolve() or path.name not in RunFolder(run).own_files():
        return path
    if out is not None:
        raise ExportError(f"{path} is one of the run's own files and would be overwritten: choose another file name.")
    return run / f"identified_{default}"


def _each_its_own(name: str) -> str:
    """Advice on how to request several formats, if `name` is a list of them; otherwise ""."""
    parts = [part for part in re.split(r"[,; ]+", name) if part]
    if len(parts) < 2 or any(part not in (*FORMATS, *RECORDING_FORMATS) for part in parts):
        return ""
    return f" Repeat the option for each: {' '.join(f'--format {part}' for part in parts)}."
