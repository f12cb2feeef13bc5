"""Numbers that stand for missing values, such as -999."""

import numpy as np

from hil.estimator.arrays import Array

CODES = tuple(
    sign * code for code in (99.0, 999.0, 9999.0, 99999.0, 999999.0, 32767.0, 65535.0) for sign in (-1.0, 1.0)
)
"""Common codes for missing values; 32767 and 65535 are the largest signed and unsigned 16-bit values."""

FEWEST = 2
APART = 2.0
"""Minimum distance between a code and all other values, relative to the range of those values."""


def without_codes(values: Array) -> tuple[Array, float | None]:
    """Replace a code for missing values by NaN; return the values and the code, which is None if there is none.

    A number is a code only if it is a common one, repeats exactly, and lies far from all other values.
    """
    known = values[np.isfinite(values)]
    for code in CODES:
        is_code = known == code
        others = known[~is_code]
        if int(is_code.sum()) < FEWEST or others.size < FEWEST:
            continue
        low, high = float(others.min()), float(others.max())
        if max(low - code, code - high) > APART * (high - low) > 0.0:
            return np.where(values == code, np.nan, values), code
    return values, None
