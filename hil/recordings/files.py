"""Recognition of recording files, and reading of their tables."""

from pathlib import Path

from hil.description.regular_file import not_a_file
from hil.errors import CsvError
from hil.recordings.csv_file import read_csv_table
from hil.recordings.mcap_file import is_bag, read_bag, read_mcap
from hil.recordings.parquet_file import is_dataset, read_dataset, read_parquet
from hil.recordings.table import Table

TEXTS = (".csv", ".txt", ".tsv", ".dat")
SUFFIXES = (*TEXTS, ".parquet", ".mcap")
UNSUPPORTED = (".db3", ".bag", ".h5", ".hdf5", ".xlsx", ".mat", ".npz", ".npy", ".json", ".jsonl", ".gz", ".zip")
"""Formats of recordings that must be converted first. They are recognised by name even if the file does not exist."""


def is_recording(path: Path) -> bool:
    """Whether `path`, judging from its name, is a recording from another tool rather than a run folder."""
    if path.is_dir():
        return is_dataset(path) or is_bag(path)
    return path.suffix.lower() in (*SUFFIXES, *UNSUPPORTED)


def read_tables(path: Path) -> list[Table]:
    """Read the tables in one file or folder. Raises CsvError; its message names that file or folder."""
    if not path.exists():
        raise CsvError(f"{path} cannot be read: No such file or directory.")
    if path.is_dir():
        return read_dataset(path) if is_dataset(path) else read_bag(path)
    if said := not_a_file(path):
        raise CsvError(f"{path} cannot be read: {said}.")
    kind = path.suffix.lower()
    if kind in TEXTS:
        return [read_csv_table(path)]
    if kind == ".parquet":
        return read_parquet(path)
    if kind == ".mcap":
        return read_mcap(path)
    raise CsvError(
        f"{path}: {kind} files are not supported. Recordings are CSV ({', '.join(TEXTS)}), Parquet or MCAP files, "
        "LeRobot datasets or ROS 2 bags: convert the file to CSV, Parquet or MCAP. For a run, give its folder."
    )
