"""Many arms of one type: how much they differ, and which one is unlike the others."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

FEWEST_ARMS = 4
_MAD_TO_STD = 1.4826
UNLIKE = 4.0
"""Robust standard deviations from the fleet's median, beyond what chance among so many values explains."""

_PREFIX, _SUFFIX = "parameters.", ".value"


@dataclass(frozen=True)
class FleetSpread:
    """One parameter over the fleet: median, and spread as 1.4826 times the median absolute deviation [SI]."""

    name: str
    median: float
    spread: float


@dataclass(frozen=True)
class Unlike:
    """One arm's parameter far from the fleet's. deviations: from the median, in combined standard deviations."""

    recording: str
    name: str
    value: float
    median: float
    deviations: float


@dataclass(frozen=True)
class Fleet:
    """What a folder of recordings says together. unlike: most striking first; empty for too few arms."""

    arms: int
    spreads: tuple[FleetSpread, ...]
    unlike: tuple[Unlike, ...]


def fleet(table: pa.Table) -> Fleet:
    """From the rows of a study with task = "estimate"; arms that could not be estimated are left out.

    An arm's own standard error counts beside the fleet's spread, so that a poor recording is not called an unlike arm.
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
