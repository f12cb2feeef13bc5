"""Axes: mapping of data to pixels, and positions of the ticks."""

import math
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Scale:
    """Maps the data range low..high to start..end in pixels, logarithmically if `log`."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False
    spacing: float = 70  # approximate px between ticks

    def pixels(self, values: Array) -> Array:
        """Pixel coordinates of data (n,)."""
        low, high = self._ends
        shown = np.log10(np.maximum(values, 1e-300)) if self.log else values
        return np.asarray(self.start + (shown - low) / (high - low) * (self.end - self.start))

    @property
    def ticks(self) -> list[float]:
        """Tick values: round numbers between low and high."""
        low, high = self._ends
        if self.log:
            return [10.0**power for power in range(math.ceil(low - 1e-9), math.floor(high + 1e-9) + 1)]
        room = max(2.0, abs(self.end - self.start) / self.spacing)
        raw = (high - low) / room
        size = 10.0 ** math.floor(math.log10(raw))
        step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= raw * (1 - 1e-9))
        first = math.ceil(low / step - 1e-9)
        return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]

    @property
    def _ends(self) -> tuple[float, float]:
        return (math.log10(self.low), math.log10(self.high)) if self.log else (self.low, self.high)


def span(values: Array, log: bool, margin: float) -> tuple[float, float]:
    """Axis limits that contain all finite values with a margin; a default range if there are none."""
    finite = values[np.isfinite(values) & (values > 0)] if log else values[np.isfinite(values)]
    if not finite.size:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    if log:
        return 10 ** math.floor(math.log10(low)), 10 ** max(
            math.ceil(math.log10(high)), math.floor(math.log10(low)) + 1
        )
    if high - low <= 1e-12 * max(1.0, abs(high)):
        room = max(1.0, abs(high)) * 0.5
        return low - room, high + room
    room = margin * (high - low)
    return low - room, high + room


def label(value: float, log: bool = False) -> str:
    """Text of a tick label; a power of ten on a logarithmic axis."""
    if log and not 0.01 <= value <= 100:
        return "10" + f"{round(math.log10(value))}".translate(_RAISED)
    return f"{value:.6g}".replace("-", "\u2212")
