"""Cleaning of rows: missing times, repeated or unordered rows, gaps, missing torque. Every correction is reported."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hil.errors import CsvError
from hil.estimator.arrays import Array, Mask
from hil.estimator.data.recording import LONGEST_GAP, MOST_GAP
from hil.recordings.encoder import encoder_step

FEW = 0.02  # largest share of the rows that may be corrected; the correction is reported
LONGEST_HOLE = 0.05  # s: longest gap in the torque that is filled in
RESTART = 0.2  # s: a larger backward step in time starts a new recording


@dataclass(frozen=True)
class Rows:
    """Rows of a recording.

    time: times of the rows (rows,) [s]. torque, position: values (joints, rows) [N m, rad]. notes: one sentence per
    correction.
    """

    time: Array
    torque: Array
    position: Array
    notes: tuple[str, ...] = ()

    def kept(self, chosen: Mask | NDArray[np.int64] | slice, *notes: str) -> "Rows":
        chosen_rows = self.time[chosen], self.torque[:, chosen], self.position[:, chosen]
        return Rows(*chosen_rows, (*self.notes, *notes))


def cleaned(source: str, rows: Rows, held: bool) -> list[Rows]:
    """Split the rows of `source` into recordings, each sorted by time. held: whether torque is held until the next row.

    Raises CsvError for defects that cannot be corrected without guessing.
    """
    rows = _with_time(source, rows)
    rows = _once(source, rows)
    parts = _restarts(rows)
    return [
        piece for part in parts for piece in _apart(_filled(source, _ordered(source, _unrepeated(source, part)), held))
    ]


def _with_time(source: str, rows: Rows) -> Rows:
    known = np.isfinite(rows.time)
    lost = int((~known).sum())
    if not lost:
        return rows
    if lost > 0.5 * known.size:
        raise CsvError(f"{source}: {lost} of {known.size} rows have no time: check the time column.")
    return rows.kept(known, f"{source}: {lost} rows without a time were left out.")


def _once(source: str, rows: Rows) -> Rows:
    every = np.vstack((rows.time, rows.torque, rows.position))
    same = np.all((every[:, 1:] == every[:, :-1]) | (np.isnan(every[:, 1:]) & np.isnan(every[:, :-1])), axis=0)
    if not same.any():
        return rows
    return rows.kept(np.concatenate(([True], ~same)), f"{source}: {int(same.sum())} repeated rows were left out.")


def _restarts(rows: Rows) -> list[Rows]:
    step = np.diff(rows.time)
    usual = float(np.median(np.abs(step))) if step.size else 0.0
    ends = np.nonzero(step < -max(RESTART, 20.0 * usual))[0] + 1
    edges = [0, *ends.tolist(), rows.time.size]
    parts = [rows.kept(slice(first, last)) for first, last in pairwise(edges)]
    if len(parts) > 1:
        often = "once" if len(parts) == 2 else f"{len(parts) - 1} times"
        said = f"Time goes back {often}, so the rows are treated as {len(parts)} recordings."
        parts[0] = parts[0].kept(slice(None), said)
    return parts


def _unrepeated(source: str, rows: Rows) -> Rows:
    again = np.concatenate(([False], np.diff(rows.time) == 0.0))
    count = int(again.sum())
    if not count:
        return rows
    if count > FEW * rows.time.size:
        percent = f"{100 * count / rows.time.size:.0f} %"
        share = f"{source}: {percent} of the time stamps repeat the previous one, with different data"
        if encoder_step(rows.time) is None:
            raise CsvError(
                f"{share}, although they have many digits: the rows were stamped when they arrived, in bursts, not "
                "when they were measured. Use the device's own time stamps, or, if the samples are equally spaced, set "
                "columns.rate (samples per second) in place of columns.time."
            )
        raise CsvError(
            f"{share}: they are too coarse. Write them with more digits, or, if the samples are equally spaced, set "
            "columns.rate (samples per second) in place of columns.time."
        )
    return rows.kept(~again, f"{source}: {count} rows with the same time as the previous row were left out.")


def _ordered(source: str, rows: Rows) -> Rows:
    back = int(np.sum(np.diff(rows.time) < 0.0))
    if not back:
        return rows
    if back > FEW * rows.time.size:
        raise CsvError(
            f"{source}: time goes back {back} times, but it must increase. Check the time column, or sort the rows."
        )
    order = np.argsort(rows.time, kind="stable")
    sorted_rows = rows.kept(order, f"{source}: {back} rows out of order were sorted by time.")
    return _unrepeated(source, sorted_rows)


def _filled(source: str, rows: Rows, held: bool) -> Rows:
    """Fill short gaps in the torque; drop the rows in long gaps."""
    hole = ~np.isfinite(rows.torque).all(axis=0)
    if not hole.any():
        return rows
    torque, out = rows.torque.copy(), np.zeros(hole.size, dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], hole.astype(np.int8), [0]))))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        inside = first > 0 and last < hole.size
        if not inside or rows.time[last] - rows.time[first - 1] > LONGEST_HOLE:
            out[first:last] = True
    for joint, row in enumerate(torque, 1):
        known = np.isfinite(row)
        if not known.any():
            raise CsvError(f"{source}: the torque or current column of joint {joint} holds no numbers at all.")
        before = np.maximum.accumulate(np.where(known, np.arange(row.size), 0))
        row[~known] = row[before][~known] if held else np.interp(rows.time[~known], rows.time[known], row[known])
    notes = []
    if (hole & ~out).any():
        notes.append(f"{source}: missing torque was filled in ({_rows(hole & ~out)}).")
    if out.any():
        notes.append(f"{source}: rows without a torque were left out ({_rows(out)}).")
    return Rows(rows.time, torque, rows.position, rows.notes).kept(~out, *notes)


def _rows(chosen: Mask) -> str:
    count = int(chosen.sum())
    return f"{count} row" + "s" * (count != 1)


def _apart(rows: Rows) -> list[Rows]:
    step = np.diff(rows.time)
    usual = float(np.median(step)) if step.size else 0.0
    if usual > MOST_GAP:
        return [rows]  # wrong unit, or much too slow: `Recording` reports which
    ends = np.nonzero(step > LONGEST_GAP)[0] + 1
    edges = [0, *ends.tolist(), rows.time.size]
    parts = [rows.kept(slice(first, last)) for first, last in pairwise(edges)]
    if len(parts) > 1:
        said = f"{len(ends)} gaps of more than {LONGEST_GAP:g} s split the recording into {len(parts)} parts."
        parts[0] = parts[0].kept(slice(None), said)
    return parts
