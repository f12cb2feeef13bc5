"""Parquet tables, and LeRobot datasets: folders of Parquet files with a meta/info.json."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import CsvError
from hil.recordings.table import Table, Values

EPISODE = "episode_index"
INFO = Path("meta") / "info.json"


def is_dataset(path: Path) -> bool:
    """Whether the folder `path` is a LeRobot dataset."""
    return (path / INFO).is_file()


def read_parquet(path: Path) -> list[Table]:
    """Read the tables in `path`, one per episode if there are episodes. Raises CsvError."""
    return _tables(path, {})


def read_dataset(folder: Path) -> list[Table]:
    """Read the episodes of a LeRobot dataset, in order. Raises CsvError."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CsvError(f"{folder / INFO} cannot be read: {error}.") from error
    features = info.get("features", {}) if isinstance(info, dict) else None
    if not isinstance(features, dict):
        raise CsvError(f'{folder / INFO} must hold an object with a table "features", as LeRobot writes it.')
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise CsvError(f"{folder} is a LeRobot dataset without data: it has no data/**/*.parquet.")
    return [table for file in files for table in _tables(file, features)]


def _tables(path: Path, features: dict[str, Any]) -> list[Table]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise CsvError("Parquet needs the package pyarrow: pip install 'hil[recordings]'.") from error
    try:
        whole = parquet.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise CsvError(f"{path} cannot be read: {str(error).splitlines()[0].rstrip('.')}.") from error
    columns: dict[str, Values] = {}
    units: dict[str, str] = {}
    for column in whole.schema:
        flat = _flat(column.name, whole.column(column.name).combine_chunks(), features.get(column.name, {}))
        columns |= flat
        stated = (column.metadata or {}).get(b"unit")
        if stated:
            units |= dict.fromkeys(flat, stated.decode())
    if not columns or not whole.num_rows:
        raise CsvError(f"{path} is empty: it has no numeric columns or no rows.")
    if EPISODE not in columns:
        return [Table(str(path), columns, units)]
    episodes = columns[EPISODE]
    return [
        Table(
            f"{path}, episode {each:.0f}", {name: values[episodes == each] for name, values in columns.items()}, units
        )
        for each in np.unique(episodes)
    ]


def _flat(name: str, column: Any, feature: dict[str, Any]) -> dict[str, Values]:
    """Convert a column to numeric columns: one per list entry, named as in the dataset; none for text."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        values = column.to_pylist()
        sizes = {len(row) for row in values if row is not None}
        if len(sizes) != 1 or not (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type)):
            return {}
        size = sizes.pop()
        rows = np.array([[np.nan] * size if row is None else row for row in values], dtype=np.float64)
        return {f"{name}.{label}": rows[:, k].copy() for k, label in enumerate(_labels(feature, size))}
    if pa.types.is_timestamp(kind):
        return {name: column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy(zero_copy_only=False) * 1e-9}
    if pa.types.is_floating(kind) or pa.types.is_integer(kind):
        return {name: np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)}
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _from_text(name, column.to_pylist())
    return {}


def _from_text(name: str, texts: list[str | None]) -> dict[str, Values]:
    """Convert a column of numbers stored as text; return no column if any entry is not a number."""
    try:
        return {name: np.array([np.nan if not text else float(text) for text in texts])}
    except ValueError:
        return {}


def _labels(feature: dict[str, Any], size: int) -> list[str]:
    """Names of a vector's entries, which may be stored under a key such as "motors"."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next((each for each in names.values() if isinstance(each, list)), None)
    if isinstance(names, list) and len(names) == size and len(set(map(str, names))) == size:
        return [str(each) for each in names]
    return [str(k) for k in range(size)]
