"""The lines that an excitation may use: multiples of 1 / period within a band."""

import math


def harmonics_within(period: float, low: float, high: float) -> range:
    """Return the multiples of 1 / `period` [s] from `low` to `high` [Hz], as whole numbers."""
    return range(max(1, math.ceil(low * period - 1e-9)), math.floor(high * period + 1e-9) + 1)
