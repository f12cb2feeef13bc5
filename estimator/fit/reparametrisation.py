"""Unconstrained coordinates for the likelihood: no step can leave the physical range.

The range, scale and longest step of each parameter are declared in `hil.estimator.models.terms`. Positive parameters
are exponentials of their coordinates. Coupling is a fraction of its bound: sqrt(inertia_1 inertia_2) tanh(z), where z
is its coordinate. This keeps the mass matrix positive definite. Likewise, viscous_asymmetry = viscous tanh(z), which
keeps friction positive in both directions.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hil.estimator.arrays import Array, Mask
from hil.estimator.models.model import LEVER_STD, Model
from hil.estimator.models.terms import BEYOND_SPEEDS, Scale, Term, joint_of, kind_of, term_of
from hil.estimator.options import CoordinateOptions

TYPICAL_SATURATION = 0.02  # typical lost fraction of the RMS torque; only a scale
LEAST_WEIGHT = 0.02  # minimum gravity_2 to be used as a scale, as a fraction of the RMS torque
TYPICAL_CABLE = 0.15  # stiffness of a stiff cable, as a fraction of the RMS torque per radian
TYPICAL_COGGING = 0.01  # typical cogging, as a fraction of the RMS torque; only a scale
LEAST_RISE = 0.05  # a Stribeck rise above this may really be Coulomb friction
TYPICAL_SQUARE = 1.0 / 3.0  # mean squared speed of a joint, relative to its highest speed squared; only a guess
MOST_DECREASE = 0.8  # maximum relative decrease in a base parameter in one step
TYPICAL_BEND = 0.01  # rad: typical presliding deflection; only a scale


@dataclass(frozen=True)
class Coordinates:
    """The map between parameters and coordinates of order 1."""

    names: tuple[str, ...]
    """Names of the parameters, as in `Model.names`."""
    scales: Array
    """Scale of each parameter (parameters,) [its unit], from `scales_of`."""
    options: CoordinateOptions
    resolved: Array | None = None
    """Lower bound of each width (parameters,) [rad/s], 0 for other parameters; `width_floor` applies if it is larger.
    """
    highest: Array | None = None
    """Upper bounds, from `highest_values` (parameters,) [its unit]; by default none."""

    def values(self, x: Array) -> Array:
        """Return the parameters (parameters,) at the coordinates `x` (parameters,)."""
        value = np.where(self._either_sign, x * self.scales, np.exp(np.where(self._either_sign, 0.0, x)))
        value += self._floors
        for share, first, second in self._shares:
            value[share] = np.sqrt(value[first] * value[second]) * np.tanh(x[share])
        return value

    def coordinates(self, value: Array) -> Array:
        """Return the coordinates of the parameters `value` (parameters,), clipped to the physical range."""
        above = np.maximum(np.minimum(value, self._highest) - self._floors, self.options.min_initial * self.scales)
        x = np.where(self._either_sign, value / self.scales, np.log(above))
        for share, first, second in self._shares:
            part = value[share] / np.sqrt(above[first] * above[second])
            most = self.options.max_initial_share
            x[share] = np.arctanh(np.clip(part, -most, most))
        return x

    def moved(self, x: Array, step: Array) -> Array:
        """Return the point that `step` (coordinates,) reaches from `x`; both arrays may have further coordinates.

        A step changes a width itself rather than its logarithm, since the motion depends linearly on the width. With
        exponential steps, a width would never reach its floor.
        """
        y = x + step
        widths = np.flatnonzero(self._floors)
        least = self.options.min_width * self._floors[widths]
        y[widths] = np.log(np.maximum(np.exp(x[widths]) * (1.0 + step[widths]), least))
        return y

    def moved_in_proportion(self, x: Array, step: Array) -> Array:
        """Return the point that `step` (coordinates,) reaches from `x`; both arrays may have further coordinates.

        Base parameters change linearly with the step, not exponentially. This straightens valleys along which only a
        sum of inertias is determined.
        """
        y, count = x + step, len(self.names)
        for index, term in enumerate(map(term_of, self.names)):
            if term.part == "base" and term.range == "positive":
                y[index] = x[index] + np.log1p(max(step[index], -MOST_DECREASE))
        value, there, slope = self.values(x[:count]), self.values(y[:count]), self.slopes(x[:count])
        for share, first, second in self._shares:
            part = (value[share] + slope[share] @ step[:count]) / np.sqrt(there[first] * there[second])
            if abs(part) < self.options.max_initial_share:
                y[share] = np.arctanh(part)
        return y

    def limit(self, x: Array, least: Array, most: Array, max_relative_decrease: float) -> None:
        """Tighten, in place, the bounds on the change of each coordinate in one step from `x` (coordinates,).

        The change in a width is limited in proportion to the width, and the change in any other parameter by its
        `Term.max_step`. At its floor, a width would hardly affect the motion, so no later step would increase it again.
        """
        least[: x.size] = np.maximum(least[: x.size], -self._longest)
        most[: x.size] = np.minimum(most[: x.size], self._longest)
        widths = np.flatnonzero(self._floors)
        share = 1.0 + self._floors[widths] * np.exp(-x[widths])  # width relative to its distance from the floor
        least[widths] = np.maximum(-1.0, -max_relative_decrease * share)
        most[widths] = self.options.max_relative_increase * share
        for index in np.flatnonzero(np.isfinite(self._highest)):
            above = np.exp(x[index])
            room = max(float(self._highest[index] - self._floors[index] - above), 0.0) / above
            most[index] = min(most[index], room if self._floors[index] else np.log1p(room))

    def undisguised(self, x: Array) -> Array:
        """Return `x` with constant Stribeck rises converted to Coulomb friction; `x` may have further coordinates.

        If the Stribeck velocity exceeds every speed in the motion, the data determine only the sum of the rise and the
        Coulomb friction, and a fit that has drifted that far rarely returns to lower Stribeck velocities.
        """
        changed = x.copy()
        for index, name in enumerate(self.names):
            if kind_of(name) != "stribeck_velocity" or not np.isfinite(self._highest[index]):
                continue
            coulomb, rise = (self.names.index(f"{kind}_{joint_of(name)}") for kind in ("coulomb", "stribeck_rise"))
            part = self._highest[index] / BEYOND_SPEEDS / np.exp(x[index])
            if part < 1.0 and np.exp(x[rise]) > LEAST_RISE:
                changed[coulomb] += np.log1p(np.exp(x[rise] - TYPICAL_SQUARE * part**2))
                changed[rise], changed[index] = np.log(LEAST_RISE), np.log(term_of(name).initial)
        return changed

    def without_wide_steps(self, x: Array, speeds: Array) -> Array:
        """Return `x` with Coulomb steps too wide for the motion converted to viscous friction; `x` may have further
        coordinates.

        Such a step has the same effect as viscous friction, so neither could be determined.

        speeds: highest speed of each joint (joints,) [rad/s].
        """
        changed, value = x.copy(), self.values(x[: len(self.names)])
        for index, (name, most) in enumerate(zip(self.names, highest_values(self.names, speeds), strict=True)):
            if kind_of(name) != "coulomb_width" or value[index] <= most:
                continue
            viscous, coulomb = (self.names.index(f"{kind}_{joint_of(name)}") for kind in ("viscous", "coulomb"))
            changed[viscous] += np.log1p(value[coulomb] / value[index] / value[viscous])
            changed[coulomb] = np.log(self.options.min_initial * self.scales[coulomb])
            changed[index] = np.log(self.scales[index])
        return changed

    def slopes(self, x: Array) -> Array:
        """Return the derivatives of the parameters with respect to the coordinates (parameters, parameters) at `x`."""
        value = self.values(x)
        slope = np.diag(np.where(self._either_sign, self.scales, value - self._floors))
        for share, first, second in self._shares:
            slope[share, share] = np.sqrt(value[first] * value[second]) / np.cosh(x[share]) ** 2
            slope[share, first] += 0.5 * value[share]
            slope[share, second] += 0.5 * value[share]
        return slope

    def ranges(self, value: Array) -> tuple[Array, Array]:
        """Return the lower and upper bounds (parameters,) of the parameters `value` (parameters,).

        Widths have no bounds: a Coulomb step narrower than its lower limit has the same effect as a sharp one. The
        bounds `highest` are left out too, since they are not physical.
        """
        positive = np.array([term_of(name).range == "positive" for name in self.names])
        lower, upper = np.where(positive, 0.0, -np.inf), np.full(value.size, np.inf)
        for share, first, second in self._shares:
            upper[share] = np.sqrt(value[first] * value[second])
            lower[share] = -upper[share]
        return lower, upper

    @property
    def floored(self) -> Mask:
        """Which parameters (parameters,) are widths, with a floor above zero."""
        return np.asarray(self._floors > 0.0)

    @cached_property
    def _either_sign(self) -> Array:
        return np.array([term_of(name).range == "any" for name in self.names])

    @cached_property
    def _floors(self) -> Array:
        floor = self.options.width_floor
        floors = np.array([floor if term_of(name).range == "floor" else 0.0 for name in self.names])
        return floors if self.resolved is None else np.maximum(floors, self.resolved)

    @cached_property
    def _highest(self) -> Array:
        return np.full(len(self.names), np.inf) if self.highest is None else self.highest

    @cached_property
    def _longest(self) -> Array:
        return np.array([term_of(name).max_step or np.inf for name in self.names])

    @cached_property
    def _shares(self) -> list[tuple[int, int, int]]:
        """Index triples: a parameter, then the two parameters whose geometric mean bounds it."""
        shares = []
        for share, name in enumerate(self.names):
            bounds, joint = term_of(name).share_of, joint_of(name)
            if bounds is not None:
                first, second = (bound if joint is None else f"{bound}_{joint}" for bound in bounds)
                shares.append((share, self.names.index(first), self.names.index(second)))
        return shares


@dataclass(frozen=True)
class CoordinatePrior:
    """Prior knowledge of the parameters: independent normal distributions of their coordinates."""

    centre: Array
    """Means (parameters,) [coordinates]."""
    precision: Array
    """Inverse variances (parameters,), 0 without prior knowledge."""

    @classmethod
    def of(cls, names: tuple[str, ...], scales: Array, sizes: "Sizes") -> "CoordinatePrior":
        """Return the prior declared by `Term.spread`, for coordinates with these scales."""
        terms = [term_of(name) for name in names]
        spread = np.array([np.inf if term.spread is None else sizes.of(term.spread) for term in terms])
        signed = np.array([term.range == "any" for term in terms])
        absent = np.array([term.absent for term in terms])
        # Near the value at which a factor has no effect, its logarithm changes as fast as the factor itself.
        centre = np.where(signed, absent / scales, np.log(np.where(signed | (absent <= 0.0), 1.0, absent)))
        precision = (np.where(signed, scales, absent) / spread) ** 2
        for index, term in enumerate(terms):
            if term.log_spread is not None:
                centre[index], precision[index] = np.log(term.initial), 1.0 / term.log_spread**2
        return cls(centre, precision)

    def weighted(self, factor: Array) -> "CoordinatePrior":
        """Return this prior with its precisions multiplied by `factor` (parameters,)."""
        return CoordinatePrior(self.centre, self.precision * factor)

    def cost(self, x: Array) -> float:
        """Return the prior's contribution to the sum of squares at the coordinates `x` (parameters,)."""
        return float(np.sum(self.precision * (x - self.centre) ** 2))


@dataclass(frozen=True)
class Lever:
    """Prior that relates two parameters: coupling is expected to be `ratio` times gravity_2."""

    coupling: int
    gravity: int
    """Indices of coupling and gravity_2 among the parameters."""
    ratio: float
    """`Model.lever` [s^2]."""
    std: float
    """Standard deviation of coupling - ratio gravity_2 [kg m^2]."""
    is_doubted: bool = False
    """Whether `std` has been increased because the motion contradicts the prior."""

    @classmethod
    def of(cls, model: Model, gravity_2: float, sizes: "Sizes") -> "Lever | None":
        """Return the prior if `model.lever` is known, otherwise None.

        gravity_2: approximate value [N m], used as a scale.
        """
        if model.lever is None or model.joints != 2:
            return None
        std = LEVER_STD * model.lever * max(abs(gravity_2), LEAST_WEIGHT * sizes.torque)
        return cls(model.names.index("coupling"), model.names.index("gravity_2"), model.lever, std)

    def residual(self, value: Array) -> tuple[float, Array]:
        """Return the deviation of the parameters `value` (parameters,) in standard deviations, and its derivatives."""
        slope = np.zeros(value.size)
        slope[self.coupling], slope[self.gravity] = 1.0 / self.std, -self.ratio / self.std
        return float(slope @ value), slope


@dataclass(frozen=True)
class Sizes:
    """Scales of an arm and its motion."""

    torque: float
    """RMS torque [N m]."""
    velocity: float
    """RMS velocity [rad/s]."""
    inertia: float
    """Typical inertia [kg m^2]."""

    def of(self, scale: Scale | float) -> float:
        """Return the value of a term's declared scale for this arm."""
        if not isinstance(scale, str):
            return scale
        return {
            "inertia": self.inertia,
            "torque": self.torque,
            "velocity": self.velocity,
            "damping": self.torque / self.velocity,
            "stiffness": self.torque / TYPICAL_BEND,
            "cable": TYPICAL_CABLE * self.torque,
            "cogging": TYPICAL_COGGING * self.torque,
            "saturation": TYPICAL_SATURATION / self.torque**2,
        }[scale]


def highest_values(names: tuple[str, ...], speeds: Array) -> Array:
    """Return the upper bounds that `Term.fastest` and `Term.largest` declare (parameters,), inf for other parameters.

    speeds: highest speed of each joint (joints,) [rad/s].
    """
    return np.array([_highest_value(term_of(name), float(speeds[(joint_of(name) or 1) - 1])) for name in names])


def _highest_value(term: Term, speed: float) -> float:
    if term.fastest is not None:
        return term.fastest * speed
    return np.inf if term.largest is None else term.largest


def scales_of(names: tuple[str, ...], sizes: Sizes) -> Array:
    """Return the scale of each parameter (parameters,)."""
    return np.array([sizes.of(term_of(name).scale) for name in names])
