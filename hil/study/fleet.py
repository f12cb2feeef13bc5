"""Comparison of many arms of one type: how much they differ, and which ones are outliers."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

FEWEST_ARMS = 4
_MAD_TO_STD = 1.4826
UNLIKE = 4.0
"""Threshold for an outlier: robust standard deviations from the fleet's median."""

_PREFIX, _SUFFIX = "parameters.", ".value"


@dataclass(frozen=True)
class FleetSpread:
    """One parameter over the fleet: median and robust standard deviation (1.4826 times the MAD) [SI]."""

    name: str
    median: float
    spread: float


@dataclass(frozen=True)
class Unlike:
    """An outlier: a parameter of one arm; deviations: distance from the median in combined standard deviations."""

    recording: str
    name: str
    value: float
    median: float
    deviations: float


@dataclass(frozen=True)
class Fleet:
    """Comparison of a fleet; unlike: outliers, largest first; empty if there are too few arms."""

    arms: int
    spreads: tuple[FleetSpread, ...]
    unlike: tuple[Unlike, ...]


def fleet(table: pa.Table) -> Fleet:
    """Compare the rows of a study with task = "estimate"; arms that could not be estimated are ignored.

    An arm's standard error is added to the fleet's spread, so that a poor recording does not count as an outlier.
    """
    names = [name[len(_PREFIX) : -len(_SUFFIX)] for name in table.column_names if _is_value(name)]
    recordings = table.column("recording").to_pylist() if "recording" in table.column_names else []
    spreads, unlike, arms = [], [], 0
    for name in names:
        value = _numbers(table, f"{_PREFIX}{name}{_SUFFIX}")
        known = np.isfinite(value)
        arms = max(arms, int(known.sum()))
        if known.sum() < FEWEST_ARMS:
            continue
        median = float(np.median(value[known]))
        spread = float(_MAD_TO_STD * np.median(np.abs(value[known] - median)))
        spreads.append(FleetSpread(name, median, spread))
        std = np.nan_to_num(_numbers(table, f"{_PREFIX}{name}.std"), nan=0.0)
        scale = np.hypot(spread, std)
        for arm in np.flatnonzero(known & (np.abs(value - median) > UNLIKE * scale)):
            deviations = float((value[arm] - median) / scale[arm]) if scale[arm] else np.inf
            unlike.append(Unlike(str(recordings[arm]), name, float(value[arm]), median, deviations))
    unlike.sort(key=lambda each: -abs(each.deviations))
    return Fleet(arms, tuple(spreads), tuple(unlike))


def _is_value(name: str) -> bool:
    return name.startswith(_PREFIX) and name.endswith(_SUFFIX)


def _numbers(table: pa.Table, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array([np.nan if each is None else float(each) for each in table.column(name).to_pylist()])
