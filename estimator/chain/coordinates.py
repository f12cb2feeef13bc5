"""Unconstrained coordinates of a chain's parameters: logarithms of positive ones, linear for the others.

A base parameter is a sum that may have either sign, so the fit itself must keep the mass matrix positive definite.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array

POSITIVE = {
    "viscous": 1e-3,
    "coulomb": 1e-3,
    "coulomb_width": 0.0,
    "stribeck_rise": 1e-3,
    "stribeck_velocity": 1e-3,
    "load": 1e-4,
    "torque_scale": 1e-3,
    "lag": 1e-5,
}
"""Kinds of positive parameters and the minimum initial value of each [its unit]."""
SMALL = {"offset": 0.01, "zero": 0.02, "delay": 1e-3}
"""Scales of the other parameters that are not base parameters [their unit]."""
SHAPES = {
    "coulomb_width": (0.01, 2.5),
    "stribeck_rise": (0.3, 1.0),
    "stribeck_velocity": (0.15, 0.7),
    "load": (0.03, 1.5),
}
"""Prior on the shape of friction near standstill: typical value [its unit] and standard deviation of its logarithm.

A joint that is never slow provides no information on these parameters; without a prior they would drift arbitrarily.
"""
RESHAPING = 1.0  # maximum change of a shape's logarithm per step
NARROWING, WIDENING = 0.8, 2.0  # maximum relative decrease and increase of a width per step
LONGEST = 2.0  # maximum change of any coordinate per step
NEAREST = 1e-3  # minimum distance of a width from its floor, as a fraction of the floor


@dataclass(frozen=True)
class ChainCoordinates:
    """The map between parameters and coordinates of order 1."""

    names: tuple[str, ...]
    scales: Array
    """Scales of the base parameters, at their indices; ignored for others (parameters,)."""
    width_floor: float
    """Lower bound of the width of every smoothed Coulomb step [rad/s]."""

    def values(self, x: Array) -> Array:
        """Return the parameters (parameters,) at the coordinates `x`."""
        positive = np.exp(np.where(self._positive, x, 0.0)) + self._floors
        value: Array = np.where(self._positive, positive, x * self._scales)
        return value

    def coordinates(self, value: Array) -> Array:
        """Return the coordinates of `value` (parameters,), moved into the physical range."""
        above = np.maximum(value - self._floors, np.maximum(self._least, NEAREST * self._floors))
        x: Array = np.where(self._positive, np.log(np.where(self._positive, above, 1.0)), value / self._scales)
        return x

    def slopes(self, x: Array) -> Array:
        """Return the derivative of each parameter by its coordinate (parameters,)."""
        slope: Array = np.where(self._positive, self.values(x) - self._floors, self._scales)
        return slope

    def limit(self, x: Array, least: Array, most: Array) -> None:
        """Set, in place, the bounds on the change of each coordinate in one step from `x`."""
        count = len(self.names)
        bound = np.where([kind in SHAPES for kind in self._kinds], RESHAPING, LONGEST)
        least[:count], most[:count] = -bound, bound
        widths = np.flatnonzero(self._floors)
        share = 1.0 + self.width_floor * np.exp(-x[widths])  # width relative to its distance from the floor
        least[widths], most[widths] = np.maximum(-1.0, -NARROWING * share), WIDENING * share

    def moved(self, x: Array, step: Array) -> Array:
        """Return the point reached by `step` from `x`; both may be followed by coordinates of something else.

        A step changes a width linearly rather than its logarithm, since the motion depends linearly on it; exponential
        steps would never reach its floor.
        """
        y: Array = x + step
        widths = np.flatnonzero(self._floors)
        y[widths] = np.log(np.maximum(np.exp(x[widths]) * (1.0 + step[widths]), NEAREST * self.width_floor))
        return y

    @cached_property
    def likely_shapes(self) -> tuple[npt.NDArray[np.int64], Array, Array]:
        """Indices of the friction-shape parameters, their typical coordinates and the standard deviations of these."""
        index = np.array([i for i, kind in enumerate(self._kinds) if kind in SHAPES], dtype=np.int64)
        pairs = np.array([SHAPES[self._kinds[i]] for i in index]).reshape(-1, 2)
        return index, np.log(pairs[:, 0]), pairs[:, 1]

    @cached_property
    def _kinds(self) -> tuple[str, ...]:
        return tuple(kind_of(name) for name in self.names)

    @cached_property
    def _positive(self) -> Array:
        return np.array([kind in POSITIVE for kind in self._kinds])

    @cached_property
    def _floors(self) -> Array:
        return np.array([self.width_floor if kind == "coulomb_width" else 0.0 for kind in self._kinds])

    @cached_property
    def _least(self) -> Array:
        return np.array([POSITIVE.get(kind, 0.0) for kind in self._kinds])

    @cached_property
    def _scales(self) -> Array:
        small: Mapping[str, float] = SMALL
        return np.array([small.get(kind, scale) for kind, scale in zip(self._kinds, self.scales, strict=True)])


def kind_of(name: str) -> str:
    """Return a parameter's name without the joint number."""
    kind, _, number = name.rpartition("_")
    return kind if number.isdigit() else name
