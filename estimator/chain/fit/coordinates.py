"""Unconstrained coordinates of a chain's parameters: logarithmic for positive ones, linear for the others.

A base parameter is a sum that may have either sign, so the fit itself must keep the mass matrix positive definite.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array, Mask

POSITIVE = {
    "viscous": 1e-3,
    "coulomb": 1e-3,
    "coulomb_width": 0.0,
    "stribeck_rise": 1e-3,
    "stribeck_velocity": 1e-3,
    "load": 1e-4,
    "torque_scale": 1e-3,
    "added_mass_scale": 1e-2,
    "lag": 1e-5,
    "lag_ratio": 0.1,
    "back_emf": 0.5,
}
"""Kinds of positive parameters, and the minimum initial value of each [in its unit]."""
SMALL = {
    "offset": 0.01,
    "zero": 0.02,
    "delay": 1e-3,
    "base_tilt_x": 0.02,
    "base_tilt_y": 0.02,
}
"""Scales of the parameters that are neither positive nor base parameters [in their units]."""
SHAPES = {
    "coulomb_width": (0.01, 2.5),
    "stribeck_rise": (0.3, 1.0),
    "stribeck_velocity": (0.15, 0.7),
    "load": (0.03, 1.5),
    "lag": (1e-3, 1.0),
    "lag_ratio": (1.0, 1.0),
    "back_emf": (0.92, 0.08),
}
"""Priors on the shape of friction and on drives: typical value [in its unit] and standard deviation of its logarithm.

Early in a fit, these parameters are held fixed: if other errors drove a lag to zero, the lag would hardly recover.
"""
ANGLES = {"zero": 0.1, "base_tilt_x": 0.1, "base_tilt_y": 0.1}
"""Priors on small angles that gravity may not reveal: standard deviations around zero [rad]."""
RESHAPING = 1.0  # maximum change of a friction-shape parameter's logarithm in one step
NARROWING, WIDENING = 1.6, 1.1  # maximum decrease and increase in a width's logarithm in one step
LONGEST = 2.0  # maximum change of any coordinate in one step


@dataclass(frozen=True)
class ChainCoordinates:
    """The map between the parameters and coordinates of magnitude about 1."""

    names: tuple[str, ...]
    scales: Array
    """Scales of the base parameters, at their indices; the other elements are ignored (parameters,)."""
    width_floor: Array
    """Minimum width of each joint's Coulomb step (joints,) [rad/s]."""

    def values(self, x: Array) -> Array:
        """Return the parameters (parameters,) at the coordinates `x`."""
        value: Array = np.where(self.positive, np.exp(np.where(self.positive, x, 0.0)), x * self._scales)
        return value

    def coordinates(self, value: Array) -> Array:
        """Return the coordinates of `value` (parameters,), moved into the physical range."""
        positive = np.log(np.where(self.positive, np.maximum(value, self._least), 1.0))
        x: Array = np.where(self.positive, positive, value / self._scales)
        return x

    def moved(self, x: Array, step: Array) -> Array:
        """Return the point reached by `step` from `x`; both arrays may have further coordinates at the end.

        If a recording barely constrains the torque scales of some joints, these scales and all parameters of the
        joints' links can change by a common factor. Steps follow this common change only if the parameters change
        exponentially, as the scales do; otherwise, only tiny steps reduce the sum of squares.
        """
        y = x + step
        if self.torque_scales.size:
            count = len(self.names)
            factor = self._following @ step[self.torque_scales]
            y[:count] = (y[:count] - factor * x[:count]) * np.exp(factor)
        return y

    def raised(self, x: Array) -> Array:
        """Return `x` with every width at or above its floor; `x` may have further coordinates at the end."""
        y = x.copy()
        y[self._widths] = np.maximum(x[self._widths], np.log(self._least[self._widths]))
        return y

    def room_below(self, x: Array) -> Array:
        """Return the largest possible decrease in each parameter's coordinate, as a negative number or 0
        (parameters,).

        Only widths have a floor. `x` may have further coordinates at the end.
        """
        least = np.full(len(self.names), -np.inf)
        least[self._widths] = np.minimum(np.log(self._least[self._widths]) - x[self._widths], 0.0)
        return least

    def slopes(self, x: Array) -> Array:
        """Return the derivative of each parameter with respect to its coordinate (parameters,)."""
        slope: Array = np.where(self.positive, self.values(x), self._scales)
        return slope

    def limit(self, x: Array, reach: float, least: Array, most: Array) -> None:
        """Set the bounds `least` and `most` on the change of each coordinate in one step from `x`, in place.

        Friction-shape parameters may change by the fraction `reach` of their usual maximum step. No width falls below
        its floor.
        """
        count = len(self.names)
        bound = np.where([kind in SHAPES for kind in self._kinds], reach * RESHAPING, LONGEST)
        least[:count], most[:count] = -bound, bound
        widths = self._widths
        least[widths] = np.maximum(self.room_below(x)[widths], -reach * NARROWING)
        most[widths] = reach * WIDENING

    @cached_property
    def likely(self) -> tuple[npt.NDArray[np.int64], Array, Array]:
        """Indices, means and standard deviations of the priors on friction shapes, drives and small angles."""
        found = [
            (i, np.log(SHAPES[kind][0]), SHAPES[kind][1]) if kind in SHAPES else (i, 0.0, ANGLES[kind] / SMALL[kind])
            for i, kind in enumerate(self._kinds)
            if kind in SHAPES or kind in ANGLES
        ]
        index, typical, spread = np.array(found).reshape(-1, 3).T
        return index.astype(np.int64), typical, spread

    @cached_property
    def torque_scales(self) -> npt.NDArray[np.int64]:
        """Indices of the torque scales, in the order of the joints."""
        return np.flatnonzero([kind == "torque_scale" for kind in self._kinds])

    @cached_property
    def _kinds(self) -> tuple[str, ...]:
        return tuple(kind_of(name) for name in self.names)

    @cached_property
    def positive(self) -> Mask:
        """Whether each parameter is positive (parameters,)."""
        return np.array([kind in POSITIVE for kind in self._kinds])

    @cached_property
    def _following(self) -> Array:
        """Weights with which parameters follow the logarithms of the torque scales (parameters, joints - 1).

        An offset follows the scale of its own joint. A link's parameters follow the mean scale of the joints from joint
        2 up to its own; those of the first link follow none.
        """
        weights = np.zeros((len(self.names), self.torque_scales.size))
        for index, (name, kind) in enumerate(zip(self.names, self._kinds, strict=True)):
            joint = int(name.rpartition("_")[2]) if kind != name else 1
            if joint > 1 and kind == "offset":
                weights[index, joint - 2] = 1.0
            elif joint > 1 and kind not in POSITIVE and kind not in SMALL:
                weights[index, : joint - 1] = 1.0 / (joint - 1)
        return weights

    @cached_property
    def _widths(self) -> npt.NDArray[np.int64]:
        return np.flatnonzero([kind == "coulomb_width" for kind in self._kinds])

    @cached_property
    def _least(self) -> Array:
        least = np.array([POSITIVE.get(kind, 0.0) for kind in self._kinds])
        least[self._widths] = self.width_floor
        return least

    @cached_property
    def _scales(self) -> Array:
        small: Mapping[str, float] = SMALL
        return np.array([small.get(kind, scale) for kind, scale in zip(self._kinds, self.scales, strict=True)])


def kind_of(name: str) -> str:
    """Return a parameter's name without the joint number."""
    kind, _, number = name.rpartition("_")
    return kind if number.isdigit() else name
