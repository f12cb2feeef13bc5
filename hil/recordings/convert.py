"""Conversion of a table, given the meaning of its columns, to recordings in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.csv_columns import TICKS, Columns
from hil.errors import CsvError
from hil.estimator.data.recording import FEWEST_SAMPLES, LEAST_MOTION, LONGEST_GAP, Recording
from hil.estimator.data.segments import FEWEST
from hil.estimator.errors import RecordingError
from hil.recordings.clean import Rows, cleaned
from hil.recordings.encoder import encoder_step
from hil.recordings.guess import guessed, said
from hil.recordings.missing_codes import without_codes
from hil.recordings.plausible import refuse_degrees, refuse_thousandths
from hil.recordings.table import Table
from hil.recordings.units import UNITS, unit_of, wrapped
from hil.recordings.velocity import contradict, rates
from hil.recordings.velocity import doubts as velocity_doubts
from hil.recordings.velocity import notes as velocity_notes

Values = NDArray[np.float64]

SMALLEST_STEP = 1e-9  # rad; for readings without visible steps, whose noise is measured instead


@dataclass(frozen=True)
class Converted:
    """Recordings in SI units.

    names: one per recording. stepped: whether each joint's encoder resolution is known. columns: description of the
    columns, including guesses. notes: one sentence per guess or correction. doubts: one sentence per contradiction
    among the columns. unusable: whether a contradiction is so large that a model would be useless.
    """

    recordings: tuple[Recording, ...]
    names: tuple[str, ...]
    stepped: tuple[bool, ...]
    columns: Columns
    notes: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    unusable: bool = False


def convert(table: Table, columns: Columns) -> Converted:
    """Convert `table` to recordings.

    Raises CsvError for columns that are missing, ambiguous or not numeric, and for data that cannot be a recording in
    these units.
    """
    whole = guessed(table, columns)
    notes = [] if whole == columns else [said(whole, table)]
    assert whole.position is not None and whole.drive is not None  # or `guessed` would have raised CsvError
    notes += _unused(table, whole)
    time = _time(table, whole)
    ticks = 0.0 if whole.ticks_per_turn is None else 2.0 * np.pi / whole.ticks_per_turn
    position = np.stack(
        [_quantity(table, name, "position", whole.position_unit, ticks, notes) for name in whole.position]
    )
    if columns.position_unit is None:  # the unit in `whole` may be a guess
        stated = [table.find(name)[2] is not None for name in whole.position]
        refuse_degrees(table.source, whole.position, time, position, stated)
    found = rates(table, time, position)
    notes += velocity_notes(found)
    if whole.angles == "absolute":
        position = np.diff(position, axis=0, prepend=0.0)
    torque = np.stack([_torque(table, whole, joint, notes) for joint in range(len(whole.position))])
    zero = np.array(whole.zero or [0.0] * len(position))[:, None]
    steps = [whole.position_step or encoder_step(row) for row in position]
    step = _steps(steps, position)
    held = whole.between == "held"
    parts = cleaned(table.source, Rows(time, torque, position + zero), held)
    notes += [note for part in parts for note in part.notes]
    long = [part for part in parts if len(parts) == 1 or _is_long_enough(part, whole.segment)]
    if len(long) < len(parts):
        notes.append(f"{table.source}: {len(parts) - len(long)} parts shorter than a segment were left out.")
    if not long:
        raise CsvError(
            f"{table.source}: gaps of more than {LONGEST_GAP:g} s split the recording into parts that are all shorter "
            f"than a segment ({whole.segment:g} s). Record for longer without gaps, or choose shorter segments "
            "(columns.segment)."
        )
    try:
        recordings = tuple(Recording(each.time, each.torque, each.position, step, whole.between) for each in long)
    except RecordingError as error:
        raise CsvError(f"{table.source}: {error}") from error
    between = min(float(np.median(np.diff(each.time))) for each in recordings)
    if whole.segment < FEWEST * between:
        raise CsvError(
            f"{table.source}: columns.segment = {whole.segment:g} s: a segment must hold at least "
            f"{FEWEST} samples, which take {FEWEST * between:.2g} s here."
        )
    names = tuple(
        table.source if len(long) == 1 else f"{table.source}, part {number}" for number in range(1, len(long) + 1)
    )
    return Converted(
        recordings,
        names,
        tuple(each is not None for each in steps),
        whole,
        tuple(notes),
        velocity_doubts(found),
        contradict(found),
    )


def _unused(table: Table, columns: Columns) -> list[str]:
    """State which keys of [columns] have no effect, so that a mistaken key does not go unnoticed."""
    stated = [columns.position_unit, *(unit_of(table.find(name)[2] or "") for name in columns.position or ())]
    unused = [f"columns.{key}" for key in columns.without_effect(in_ticks=TICKS in stated)]
    if not unused:
        return []
    have = "has" if len(unused) == 1 else "have"
    return [f"{table.source}: {', '.join(unused)} {have} no effect on columns of {columns.drive} and position."]


def _steps(found: Sequence[float | None], position: Values) -> Values:
    """The encoder steps (joints,); a joint that moves too little to reveal its step is given that of another joint."""
    known = max((each for each in found if each is not None), default=SMALLEST_STEP)
    swing = np.nanmax(position, axis=1, initial=-np.inf) - np.nanmin(position, axis=1, initial=np.inf)
    other = np.where(swing < LEAST_MOTION * known, known, SMALLEST_STEP)
    return np.array([each or float(others) for each, others in zip(found, other, strict=True)])


def _is_long_enough(part: Rows, segment: float) -> bool:
    return part.time.size >= FEWEST_SAMPLES and float(part.time[-1] - part.time[0]) >= segment


def _time(table: Table, columns: Columns) -> Values:
    if columns.time is None:
        assert columns.rate is not None
        return np.arange(table.rows) / columns.rate
    full, values, stated = table.find(columns.time)
    unit = _unit(table, full, "time", stated, columns.time_unit)
    finite = values[np.isfinite(values)]
    # Subtract the first sample: as a float, nanoseconds since 1970 would lose their last digits.
    first = float(finite[0]) if finite.size else 0.0
    return np.asarray((values - first) * UNITS["time"][unit])


def _torque(table: Table, columns: Columns, joint: int, notes: list[str]) -> Values:
    kind = columns.drive
    assert kind is not None
    name = getattr(columns, kind)[joint]
    values = _quantity(table, name, kind, getattr(columns, f"{kind}_unit"), notes=notes)
    if table.find(name)[2] is None and getattr(columns, f"{kind}_unit") is None:
        refuse_thousandths(table.source, name, kind, values)
    if kind == "pwm":
        assert columns.supply_voltage is not None
        if float(np.nanmax(np.abs(values), initial=0.0)) > 1.5:
            raise CsvError(
                f"{table.source}: column {name!r} reaches {float(np.nanmax(np.abs(values))):.4g}; a fraction of the "
                'supply voltage is at most 1: is it in percent (pwm_unit = "%")?'
            )
        values = values * columns.supply_voltage
    gains = columns.gains
    return values if gains is None else values * gains[joint]


def _quantity(
    table: Table, name: str, kind: str, given: str | None, ticks: float = 0.0, notes: list[str] | None = None
) -> Values:
    """Return a column in SI units; append a sentence to `notes` if it was corrected."""
    full, values, stated = table.find(name)
    unit = _unit(table, full, kind, stated, given)
    values, code = without_codes(values)
    if code is not None and notes is not None:
        notes.append(
            f"{table.source}: column {full!r} contains {code:g}, which is far from all its other values: these samples "
            "are treated as missing."
        )
    bits = wrapped(values, (32,) if kind == "position" else (16, 32))
    if bits is not None and notes is not None:
        values = np.where(values >= 2.0 ** (bits - 1), values - 2.0**bits, values)
        notes.append(
            f"{table.source}: column {full!r} wraps at 2^{bits}: its registers were read as unsigned numbers; here "
            "they are interpreted as signed."
        )
    if unit == TICKS and not ticks:
        raise CsvError(
            f"{table.source}: column {full!r} is in ticks: set columns.ticks_per_turn (4096 for X-series servos)."
        )
    return values * (ticks if unit == TICKS else UNITS[kind][unit])


def _unit(table: Table, name: str, kind: str, stated: str | None, given: str | None) -> str:
    """The unit of a column, from [columns] or the file. Raises CsvError if they disagree or a unit is unknown."""
    possible = UNITS[kind]
    read = None if stated is None else unit_of(stated)
    if read == "1" and kind != "pwm":
        read = None
    if given is None:
        if stated is None:
            return next(iter(possible)) if kind != "pwm" else "1"
        if read is None or read not in possible:
            raise CsvError(
                f"{table.source}: column {name!r} states the unit {stated!r}, which is not one of "
                f"{', '.join(possible)}: convert it, or set columns.{kind}_unit."
            )
        return read
    if read is not None and read != given:
        raise CsvError(
            f"{table.source}: column {name!r} states the unit {read}, but columns.{kind}_unit says {given}: one of "
            "them is wrong."
        )
    return given
