"""The rows of a study as a Parquet dataset that can be read while it is being written.

DIR/rows/part-000000.parquet, ...   each written completely or not at all; a row is in only one part
DIR/study.toml                      an exact copy of the study
DIR/about.json                      versions, seed, number of runs
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hil.errors import RunFolderError, not_written
from hil.study.work import Row

_PART = "part-*.parquet"
_WHOLE = ("run", "seed", "worker")
"""Columns of integers."""


class Dataset:
    """The Parquet files in a folder, which must have only one writer at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._next = 1 + max((_number(path) for path in folder.glob(_PART)), default=-1)

    def append(self, rows: Sequence[Row]) -> None:
        """Write one part. Raises RunFolderError, for example if the disk is full."""
        if not rows:
            return
        path = self.folder / f"part-{self._next:06d}.parquet"
        temporary = path.with_suffix(".partial")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            pq.write_table(_table(rows), temporary)
            temporary.replace(path)
        except OSError as error:
            raise not_written(path, error) from error
        self._next += 1

    def done(self) -> set[int]:
        """Numbers of the runs that have a row."""
        found: set[int] = set()
        for path in self._parts():
            found |= set(_read(path, ["run"]).column("run").to_pylist())
        return found

    def table(self) -> pa.Table:
        """All rows in the order of their runs. Columns that a part lacks are null in its rows."""
        parts = [_read(path) for path in self._parts()]
        if not parts:
            return pa.table({"run": pa.array([], pa.int64())})
        return pa.concat_tables(_alike(parts), promote_options="permissive").sort_by("run")

    def compact(self) -> None:
        """Replace all parts by a single one in the order of the runs, so that every reader sees the same schema."""
        old = self._parts()
        table = self.table()
        whole = self.folder / f"part-{self._next:06d}.parquet"
        # Between these two steps readers see rows twice, but never too few; `_parts` ignores leftovers of a crash.
        temporary = whole.with_suffix(".partial")
        marked = table.replace_schema_metadata({b"replaces": ",".join(path.name for path in old).encode()})
        pq.write_table(marked, temporary)
        temporary.replace(whole)
        for path in old:
            path.unlink()
        self._next += 1

    def _parts(self) -> list[Path]:
        parts = sorted(self.folder.glob(_PART))
        replaced: set[str] = set()
        for path in parts:
            metadata = pq.read_schema(path).metadata or {}
            replaced |= set(metadata.get(b"replaces", b"").decode().split(","))
        return [path for path in parts if path.name not in replaced]


def _alike(parts: list[pa.Table]) -> list[pa.Table]:
    """Convert columns that hold numbers in one part and text in another to text."""
    kinds: dict[str, set[pa.DataType]] = {}
    for part in parts:
        for field in part.schema:
            if not pa.types.is_null(field.type):
                kinds.setdefault(field.name, set()).add(field.type)
    mixed = {name for name, types in kinds.items() if len(types) > 1}
    return [_with_text(part, mixed & set(part.column_names)) for part in parts]


def _with_text(part: pa.Table, names: set[str]) -> pa.Table:
    for name in names:
        part = part.set_column(part.column_names.index(name), name, part.column(name).cast(pa.string()))
    return part


def _number(path: Path) -> int:
    return int(path.stem.split("-")[1])


def _read(path: Path, columns: list[str] | None = None) -> pa.Table:
    try:
        return pq.read_table(path, columns=columns, partitioning=None)
    except (OSError, pa.ArrowInvalid) as error:
        raise RunFolderError(f"{path} is damaged: {error}. Remove it and use --resume.") from error


def _table(rows: Iterable[Row]) -> pa.Table:
    """Make a table with columns in order of appearance."""
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    return pa.table({name: _column([row.get(name) for row in rows], name) for name in names})


def _column(values: list[Any], name: str) -> pa.Array:
    kinds = {type(value) for value in values if value is not None}
    if name in _WHOLE:
        return pa.array(values, pa.int64())
    if kinds <= {bool}:
        return pa.array(values, pa.bool_()) if kinds else pa.nulls(len(values))
    if kinds <= {int, float}:
        # Even if this part holds only integers, because the next one may not.
        return pa.array([None if value is None else float(value) for value in values], pa.float64())
    return pa.array([None if value is None else str(value) for value in values], pa.string())
