"""Rejection of angles, torques, currents and voltages that no servo arm reaches. Usually, their columns state no unit.

Joints that rotate continuously are accepted, and so is everything if [columns] states the unit. A torque, current or
voltage is also accepted if its column states the unit.
"""

import math
from collections.abc import Sequence

import numpy as np

from hil.drivers.servo_model import fastest_no_load
from hil.errors import CsvError
from hil.estimator.arrays import Array

MOST_RANGE_RAD = 4 * math.pi
"""Widest plausible range of a joint that moves back and forth [rad]."""

TIMES_STATED = 3.0
"""Factor by which the range may be wider if the column states its unit."""

TIMES_NO_LOAD = 5.0
"""Highest plausible speed, relative to the no-load speed of the fastest servo."""

MOST_DRIVE = {"torque": (60.0, "N m", "mN m"), "current": (40.0, "A", "mA"), "voltage": (60.0, "V", "mV")}
"""Largest plausible value of each kind of drive command, its SI unit, and the usual unit of larger numbers. The
largest servos (PH54) deliver 45 N m continuously and run on 24 V.
"""

_ONE_WAY = 0.7
"""A joint counts as rotating continuously if at least this fraction of its path is in one direction."""

_MOST_DEGREES = 720.0
"""Angle in degrees that most joints never exceed; register values of servos are usually larger."""

_OVER_S, _USUAL = 0.02, 0.9
"""Time over which speeds are averaged to suppress noise [s], and the quantile of the speeds that is checked."""


def refuse_degrees(
    source: str, names: Sequence[str], time: Array, position: Array, stated: Sequence[bool] | None = None
) -> None:
    """Raise CsvError if `position` (joints, samples) [rad] is beyond the range of servos.

    names: columns of the positions. time: sampling times (samples,) [s]. stated: whether each column states its
    unit, in which case several turns are accepted; by default, none does.
    """
    fastest = TIMES_NO_LOAD * fastest_no_load()
    for name, row, is_stated in zip(names, position, stated or (False,) * len(names), strict=True):
        known = np.isfinite(row) & np.isfinite(time)
        if not known.any():
            continue
        speed, path = _speed(time[known], row[known]), float(np.abs(np.diff(row[known])).sum())
        low, high = float(row[known].min()), float(row[known].max())
        rotates = high - low > _ONE_WAY * path
        if speed > fastest:
            what = f"its speed, {speed:.4g} rad/s, is more than {TIMES_NO_LOAD:g} times that of any servo"
        elif high - low > MOST_RANGE_RAD * (TIMES_STATED if is_stated else 1.0) and not rotates:
            what = f"it swings through {(high - low) / (2 * math.pi):.2g} turns"
        else:
            continue
        unit, key = ("encoder ticks", "ticks") if _are_ticks(row[known]) else ("degrees", "deg")
        turn = " and ticks_per_turn (4096 for X-series servos)" if key == "ticks" else ""
        raise CsvError(
            f"{source}: column {name!r} goes from {low:.4g} to {high:.4g} rad: {what}. Is it in {unit}? Then correct "
            f'the unit in the column\'s header; if the header has none, set position_unit = "{key}"{turn} in [columns] '
            'of --config ARM.toml (in Python: config="ARM.toml"). If it is in rad, set position_unit = "rad" there. '
            "Check the unit of time, too."
        )


def refuse_thousandths(source: str, name: str, kind: str, values: Array) -> None:
    """Raise CsvError if `values` (samples,) of a column without a unit are too large for the SI unit.

    kind: a key of `MOST_DRIVE`; values of other kinds are accepted.
    """
    if kind not in MOST_DRIVE:
        return
    limit, unit, other = MOST_DRIVE[kind]
    most = float(np.nanmax(np.abs(values), initial=0.0))
    if most > limit:
        raise CsvError(
            f"{source}: column {name!r} states no unit and reaches {most:.4g}, which would be {most:.4g} {unit}: too "
            f"much for any servo. Is it in {other}? Then append [{other}] to the column's name, or set "
            f'{kind}_unit = "{other}" in [columns] of --config ARM.toml (in Python: config="ARM.toml"). If it is in '
            f'{unit}, set {kind}_unit = "{unit}" there.'
        )


def _are_ticks(values: Array) -> bool:
    """Whether the values look like those of a servo's register: whole numbers that are too large for degrees."""
    return bool(np.all(values == np.round(values)) and np.abs(values).max() > _MOST_DEGREES)


def _speed(time: Array, position: Array) -> float:
    """Speed that a joint seldom exceeds [rad/s]; 0 if the recording is too short to tell."""
    step = np.diff(time)
    usual = float(np.median(step)) if step.size else 0.0
    lag = max(1, round(_OVER_S / usual)) if usual > 0.0 else 0
    if not 0 < lag < time.size:
        return 0.0
    elapsed = time[lag:] - time[:-lag]
    speeds = np.abs(position[lag:] - position[:-lag])[elapsed > 0.0] / elapsed[elapsed > 0.0]
    return float(np.quantile(speeds, _USUAL)) if speeds.size else 0.0
