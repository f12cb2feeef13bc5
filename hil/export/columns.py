"""The recording as scalar columns, for formats that do not support arrays within a row."""

import numpy as np
from numpy.typing import NDArray

from hil.export.source import Recorded

COLUMN_UNITS = {
    "deadline": "s",
    "time_before_write": "s",
    "time_after_read": "s",
    "goal_current": "A",
    "current": "A",
    "velocity": "rad/s",
    "position": "rad",
    "servo_clock": "s",
    "supply_voltage": "V",
    "temperature": "degrees C",
}


def columns(source: Recorded) -> dict[str, NDArray[np.generic]]:
    """Columns (samples,) by name; columns that exist per joint are numbered from the base: position_1, position_2."""
    samples = source.samples
    found: dict[str, NDArray[np.generic]] = {}
    for name in samples.dtype.names or ():
        column = samples[name]
        if column.ndim == 1:
            found[name] = column
        else:
            found |= {f"{name}_{joint + 1}": column[:, joint] for joint in range(column.shape[1])}
    return found


def unit(column: str) -> str:
    """The unit of a column; empty for counts."""
    return COLUMN_UNITS.get(column.rstrip("0123456789").rstrip("_"), COLUMN_UNITS.get(column, ""))
