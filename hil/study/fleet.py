"""Comparison of many arms: how much arms of one type differ, and which of them are outliers."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

FEWEST_ARMS = 4
_MAD_TO_STD = 1.4826
UNLIKE = 4.0
"""Distance from the fleet's median beyond which an arm is an outlier [robust standard deviations]."""

_PREFIX, _SUFFIX = "parameters.", ".value"
_TYPE, _TRUST = "arm_type", "verdict.trust"

Floats = np.ndarray[tuple[int], np.dtype[np.float64]]


@dataclass(frozen=True)
class FleetSpread:
    """One parameter over the fleet: median and robust standard deviation (1.4826 times the median absolute deviation)
    [SI].
    """

    name: str
    median: float
    spread: float


@dataclass(frozen=True)
class Unlike:
    """An outlying parameter of one arm. deviations: distance from the median in combined standard deviations."""

    recording: str
    name: str
    value: float
    median: float
    deviations: float


@dataclass(frozen=True)
class FleetArm:
    """One arm of the fleet: its recording, its verdict, and its parameters in the order of `Fleet.spreads` [SI].

    deviations: distance from the median in combined standard deviations, in the same order; NaN where not identified.
    """

    recording: str
    trust: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]


@dataclass(frozen=True)
class Fleet:
    """Comparison of the arms of one type.

    unlike: outliers, the largest first. With too few arms, `unlike` and `spreads` are empty.
    """

    type: str
    arms: tuple[FleetArm, ...]
    spreads: tuple[FleetSpread, ...]
    unlike: tuple[Unlike, ...]


def fleets(table: pa.Table) -> list[Fleet]:
    """Compare the arms of the same type, i.e. with the same servos, in the rows of a study with task = "estimate".

    Arms that could not be estimated are ignored. The largest fleet comes first.
    """
    types = _texts(table, _TYPE)
    known = [name for name, _ in Counter(each for each in types if each).most_common()] or [""]
    return [_fleet(name, table.filter(pa.array([each == name for each in types]))) for name in known]


def _fleet(kind: str, table: pa.Table) -> Fleet:
    """Compare arms of one type.

    An arm's standard error is added to the fleet's spread, so that a poor recording does not make it an outlier.
    """
    recordings, trusts = _texts(table, "recording"), _texts(table, _TRUST)
    spreads, values, deviations = [], [], []
    for name in [column[len(_PREFIX) : -len(_SUFFIX)] for column in table.column_names if _is_value(column)]:
        value = _numbers(table, f"{_PREFIX}{name}{_SUFFIX}")
        known = np.isfinite(value)
        if known.sum() < FEWEST_ARMS:
            continue
        median = float(np.median(value[known]))
        spread = float(_MAD_TO_STD * np.median(np.abs(value[known] - median)))
        spreads.append(FleetSpread(name, median, spread))
        values.append(value)
        deviations.append(_deviations(value - median, spread, _numbers(table, f"{_PREFIX}{name}.std")))
    arms = [
        FleetArm(recording, trust, tuple(float(v[row]) for v in values), tuple(float(d[row]) for d in deviations))
        for row, (recording, trust) in enumerate(zip(recordings, trusts, strict=True))
        if not spreads or any(np.isfinite(v[row]) for v in values)
    ]
    unlike = [
        Unlike(arm.recording, spread.name, value, spread.median, deviation)
        for arm in arms
        for spread, value, deviation in zip(spreads, arm.values, arm.deviations, strict=True)
        if abs(deviation) > UNLIKE
    ]
    unlike.sort(key=lambda each: -abs(each.deviations))
    return Fleet(kind, tuple(arms), tuple(spreads), tuple(unlike))


def _deviations(away: Floats, spread: float, std: Floats) -> Floats:
    scale = np.hypot(spread, np.nan_to_num(std, nan=0.0))
    exact = np.where(np.isnan(away) | (away == 0.0), away, np.copysign(np.inf, away))
    return np.asarray(np.divide(away, scale, out=exact, where=scale > 0.0))


def _is_value(name: str) -> bool:
    return name.startswith(_PREFIX) and name.endswith(_SUFFIX)


def _texts(table: pa.Table, name: str) -> list[str]:
    if name not in table.column_names:
        return [""] * table.num_rows
    return ["" if each is None else str(each) for each in table.column(name).to_pylist()]


def _numbers(table: pa.Table, name: str) -> Floats:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array([np.nan if each is None else float(each) for each in table.column(name).to_pylist()])
