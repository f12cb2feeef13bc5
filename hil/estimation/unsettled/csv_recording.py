"""Reader for a CSV file with named columns; gives a recording in SI units."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.config.csv_columns import CURRENT_UNITS, POSITION_UNITS, TIME_UNITS, TORQUE_UNITS, Columns
from hil.errors import CsvError
from hil.estimator.data.recording import Recording
from hil.runs.file_size import MOST_CSV_BYTES

Values = NDArray[np.float64]


def read_csv(path: Path, columns: Columns) -> Recording:
    """Read the recording in `path`. An empty field or `nan` is a missing value.

    Raises CsvError for missing columns and fields that are not numbers, and RecordingError for data that cannot be a
    recording in these units.
    """
    read = _read(path)
    time = _column(path, read, columns.time) * TIME_UNITS[columns.time_unit]
    scale = POSITION_UNITS[columns.position_unit]
    zero = np.array(columns.zero or [0.0] * len(columns.position))[:, None]
    position = np.stack([_column(path, read, name) for name in columns.position]) * scale
    step = _steps(position) if columns.position_step is None else np.full(len(position), columns.position_step)
    return Recording(time, _torque(path, read, columns), position + zero, step, columns.between)


def _torque(path: Path, read: dict[str, Values], columns: Columns) -> Values:
    if columns.torque is not None:
        torque = np.stack([_column(path, read, name) for name in columns.torque])
        return np.asarray(torque * TORQUE_UNITS[columns.torque_unit])
    assert columns.current is not None and columns.torque_constant is not None  # checked by Columns
    current = np.stack([_column(path, read, name) for name in columns.current])
    return np.asarray(current * CURRENT_UNITS[columns.current_unit] * np.array(columns.torque_constant)[:, None])


def _read(path: Path) -> dict[str, Values]:
    try:
        if path.stat().st_size > MOST_CSV_BYTES:
            raise CsvError(f"{path}: is larger than {MOST_CSV_BYTES // 2**20} MB, the maximum. Split it.")
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            rows = [row for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CsvError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    if not header or not rows:
        raise CsvError(f"{path}: is empty; it needs a header line and at least one line of numbers.")
    double = {name for name in header if header.count(name) > 1}
    if double:
        raise CsvError(f"{path}: two columns are named {sorted(double)[0]!r}; rename one of them.")
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise CsvError(f"{path}, line {number}: {len(row)} fields for {len(header)} columns.")
    numbers = np.empty((len(rows), len(header)))
    for k, row in enumerate(rows):
        for i, field in enumerate(row):
            try:
                numbers[k, i] = float(field) if field.strip() else np.nan
            except ValueError:
                # Unused columns may hold text; only used columns are checked for numbers.
                numbers[k, i] = np.inf
    return dict(zip(header, numbers.T, strict=True))


def _column(path: Path, read: dict[str, Values], name: str) -> Values:
    if name not in read:
        raise CsvError(f"{path}: has no column {name!r}; it has {', '.join(read)}. Set [columns] in the TOML.")
    values = read[name]
    bad = np.nonzero(np.isinf(values))[0]
    if bad.size:
        raise CsvError(f"{path}, line {bad[0] + 2}: column {name!r} is not a number.")
    return values


def _steps(position: Values) -> Values:
    """Encoder step of each joint (joints,) [rad]: the smallest recurring difference, or a millionth of the swing."""
    steps = []
    for row in position:
        finite = row[np.isfinite(row)]
        levels = np.unique(np.round(np.abs(np.diff(finite)), 9))
        levels = levels[levels > 0.0]
        swing = float(np.ptp(finite)) if finite.size else 0.0
        if not levels.size:
            steps.append(max(1e-9, 1e-6 * swing))
            continue
        usual = float(np.percentile(levels, 5))
        steps.append(max(min(usual, float(levels[0]) * 2.0), 1e-6 * swing, 1e-9))
    return np.array(steps)
