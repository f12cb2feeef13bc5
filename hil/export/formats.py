"""The export formats by name: the function that writes each, and its default file name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from hil.errors import ExportError
from hil.export.mcap import export_mcap
from hil.export.mjcf import export_mjcf
from hil.export.parameters import export_json, export_toml
from hil.export.source import Source
from hil.export.tables import export_csv, export_mat, export_parquet
from hil.export.urdf import export_urdf

Exporter = Callable[[Source, Path], list[str]]


@dataclass(frozen=True)
class Format:
    """One format.

    write: writes a file and returns what it cannot represent. file_name: default name in the run folder.
    """

    write: Exporter
    file_name: str


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "urdf": Format(export_urdf, "arm.urdf"),
        "mjcf": Format(export_mjcf, "arm.xml"),
        "toml": Format(export_toml, "arm.toml"),
        "json": Format(export_json, "arm.json"),
        "csv": Format(export_csv, "samples.csv"),
        "parquet": Format(export_parquet, "samples.parquet"),
        "mcap": Format(export_mcap, "samples.mcap"),
        "mat": Format(export_mat, "samples.mat"),
    }
)


@dataclass(frozen=True)
class Written:
    """A file that was written, and what its format cannot represent."""

    format: str
    path: Path
    left_out: list[str]


def export(run: Path, name: str, out: Path | None = None, link_length: float | None = None) -> Written:
    """Write the run in one format, by default into the run folder. Raises ResultError, ExportError, RunFolderError."""
    if name not in FORMATS:
        raise ExportError(f"{name!r} is not a format of hil export. Possible: {', '.join(FORMATS)}.")
    chosen = FORMATS[name]
    path = out or run / chosen.file_name
    return Written(name, path, chosen.write(Source.open(run, link_length), path))
