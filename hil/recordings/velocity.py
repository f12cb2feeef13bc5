"""Comparison of recorded velocities with the positions: a wrong time scale leaves no other trace.

Parameters absorb a wrong time scale: if the recorded times are twice the true ones, the estimated inertia is four times
too large. Velocities are otherwise not used.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.recordings.table import Table
from hil.recordings.units import split_head

WINDOW = 0.5  # s over which motion is averaged, so that noise and filters of the velocity hardly matter
FEWEST_WINDOWS = 8
LONGEST_LAG = 0.3  # s
LONGEST_GAP = 0.25  # s between rows: longer gaps are left out, with all windows that overlap them
ALIKE = 0.99  # correlation of the two motions below which a column is not the velocity of that joint
APART = 0.04  # smallest relative difference that is worth a warning
FAR_APART = 0.2  # logarithm of the factor beyond which the result is unusable: inertias are off by 50 %
LATE = 0.02  # s; smallest lag or lead that is mentioned
KNOWN_UNITS = (1.0, 180.0 / math.pi, 30.0 / math.pi, 30.0 / math.pi / 0.229)  # rad/s, deg/s, rpm, X-series ticks
_VELOCITY = re.compile(r"(?<![a-z])(vel|velocity|speed|omega|dq|qd|qdot)(?![a-z])", re.I)
_NOT_MEASURED = re.compile(
    r"(?<![a-z])(des|desired|ref|reference|goal|target|sp|setpoint|cmd|commanded|err)(?![a-z])", re.I
)


@dataclass(frozen=True)
class Rate:
    """A velocity column: `factor` times the derivative of the joint's position, delayed by `late` [s]."""

    column: str
    factor: float
    late: float


def rates(table: Table, time: Array, position: Array) -> tuple[Rate, ...]:
    """Compare the velocity columns with `position` (joints, rows) [rad] at `time` (rows,) [s].

    Returns () unless there is one velocity column per joint, and each follows the motion of its joint.
    """
    columns = _columns(table)
    if len(columns) != len(position):
        return ()
    found = [_rate(name, time, row, table.columns[name]) for name, row in zip(columns, position, strict=True)]
    known = tuple(each for each in found if each is not None)
    return known if len(known) == len(position) else ()


def contradict(found: Sequence[Rate]) -> bool:
    """Whether velocities contradict positions so strongly that a model based on either would be useless."""
    return any(abs(math.log(factor)) > FAR_APART for factor in _factors(found))


def doubts(found: Sequence[Rate]) -> tuple[str, ...]:
    """Sentences about velocities that contradict the positions."""
    factors = _factors(found)
    wrong = [joint for joint, factor in enumerate(factors, 1) if abs(math.log(factor)) > APART]
    if not wrong:
        return ()
    if len(found) > 1 and len(wrong) == len(found) and max(factors) < (1.0 + APART) * min(factors):
        factor = float(np.mean(factors))
        return (
            f"The velocity columns are {factor:.3g} times the rates at which the positions change: either the times "
            f"or both velocities have a wrong scale. If times are {factor:.3g} times too long, inertias are "
            f"{factor**2:.3g} times too large: check the unit of time and the sample rate. If only the "
            "velocities have another unit, leave these columns out: nothing else uses them.",
        )
    return tuple(
        f"Column {found[joint - 1].column!r} is {factors[joint - 1]:.3g} times the rate at which the position of joint "
        f"{joint} changes: that velocity or the angle of joint {joint}{' (or time)' if len(found) == 1 else ''} has a "
        "wrong scale. Check units, gear ratio and sample rate."
        for joint in wrong
    )


def _factors(found: Sequence[Rate]) -> list[float]:
    """The factors of all columns, relative to the known unit of velocity that fits them best."""
    unit = min(KNOWN_UNITS, key=lambda each: max((abs(math.log(rate.factor / each)) for rate in found), default=0.0))
    return [rate.factor / unit for rate in found]


def notes(found: Sequence[Rate]) -> tuple[str, ...]:
    """Sentences about velocities that lead or lag the positions."""
    return tuple(
        f"Column {rate.column!r} is {1e3 * abs(rate.late):.2g} ms {'behind' if rate.late > 0.0 else 'ahead of'} the "
        "position; velocities are not used."
        for rate in found
        if abs(rate.late) > LATE
    )


def _columns(table: Table) -> list[str]:
    named = []
    for name in table.columns:
        words = re.sub(r"(?<=[a-z])(?=\d)|[_./\[\]\-]+", " ", split_head(name)[0])
        if _VELOCITY.search(words) and not _NOT_MEASURED.search(words):
            named.append(name)
    return named


def _rate(column: str, time: Array, position: Array, velocity: Array) -> Rate | None:
    time, position, velocity = _in_order(time, position, velocity)
    if time.size < FEWEST_WINDOWS or time[-1] - time[0] < FEWEST_WINDOWS * WINDOW:
        return None
    step = float(np.median(np.diff(time)))
    travelled = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time))))
    at = np.arange(time[0] + WINDOW + LONGEST_LAG, time[-1] - WINDOW - LONGEST_LAG, max(step, 0.02))
    for gap in np.flatnonzero(np.diff(time) > LONGEST_GAP):
        at = at[(at < time[gap] - WINDOW - LONGEST_LAG) | (at > time[gap + 1] + WINDOW + LONGEST_LAG)]
    if at.size < FEWEST_WINDOWS:
        return None
    moved = _increase(at, time, position)
    lags = np.arange(-LONGEST_LAG, LONGEST_LAG + 0.5 * step, min(step, 0.01))
    each = [_increase(at + lag, time, travelled) for lag in lags]
    if not moved.any() or not all(row.any() for row in each):
        return None
    alike = [float(np.corrcoef(moved, row)[0, 1]) for row in each]
    best = int(np.argmax(np.abs(alike)))
    if not abs(alike[best]) > ALIKE:
        return None
    # Noise in the regressor would bias a regression in either direction; the ratio of the amplitudes lies in between.
    factor = float(np.std(each[best]) / np.std(moved))
    return Rate(column, factor, float(lags[best])) if alike[best] > 0.0 else None


def _in_order(time: Array, *values: Array) -> tuple[Array, ...]:
    """Return the rows without missing values, sorted by time; of rows with the same time, only the first is kept."""
    known = np.flatnonzero(np.all(np.isfinite((time, *values)), axis=0))
    known = known[np.argsort(time[known], kind="stable")]
    known = known[np.concatenate(([True], np.diff(time[known]) > 0.0))[: known.size]]
    return tuple(each[known] for each in (time, *values))


def _increase(at: Array, time: Array, values: Array) -> Array:
    """Increase of `values` over a window around each time, averaged over shifts of up to half the window's length."""
    fine = np.linspace(-0.5 * WINDOW, 0.5 * WINDOW, 9)
    mean = sum(
        np.interp(at + shift + 0.5 * WINDOW, time, values) - np.interp(at + shift - 0.5 * WINDOW, time, values)
        for shift in fine
    )
    return np.asarray(mean) / fine.size
