"""Spectral lines available to an excitation: multiples of 1 / period within a band."""

import math


def harmonics_within(period: float, low: float, high: float) -> range:
    """Return the harmonic numbers of 1 / `period` (period in s) from `low` to `high` [Hz]."""
    return range(max(1, math.ceil(low * period - 1e-9)), math.floor(high * period + 1e-9) + 1)
