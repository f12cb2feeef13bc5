"""Detection of identified values that are many standard deviations away from configured or typical ones.

If the model lacks an effect, such as gear backlash, other parameters imitate it. A large deviation from a value known
beforehand reveals this; standard errors do not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.terms import kind_of, term_of

FAR = 4.0  # standard deviations
LARGE_RATIO, LARGE_ANGLE = 0.35, 0.3
"""Relative and absolute deviations [1, rad] from a configured value that are too large to be due to magnet temperature,
tolerances or a horn fitted one tooth off.
"""
LARGE_SPREAD = 0.3  # standard deviation of a logarithm above which it is printed as a factor
Trust = Literal["yes", "with care", "no"]
Source = Literal["file", "description", "servos"]
"""Origin of an expected value: the configuration, the description of the links (URDF), or typical servo parameters."""
_GIVEN = ("torque_scale", "zero")
"""Terms whose expected values come from the configuration (from its keys torque_constant and zero_ticks)."""
_SOURCES: dict[Source, str] = {
    "file": "implied by the configuration",
    "description": "implied by the description of the arm",
    "servos": "typical of servos",
}
_CHECKS = {
    "torque_scale": "check the servo model, torque_constant and torque_constant_std of each joint, or measure the "
    "constants with `hil calibrate`",
    "zero": "check zero_ticks and the horn's position",
    "base_tilt": "check arm.base",
    "encoder": "check the encoder and its magnet",
    "stribeck_velocity": "use slower motion, so that friction near standstill can be determined",
}
_DRIVE = "check the joint's servo model and mode"
_LINK = "correct that link's mass, centre of mass and inertia in the description, or check what the arm carries"


@dataclass(frozen=True)
class Conflict:
    """An identified value that is far from the value known beforehand."""

    name: str
    value: float
    std: float
    """Standard error of `value`."""
    expected: float
    spread: float
    """Standard deviation of `expected`; if `relative`, of its logarithm."""
    relative: bool
    deviations: float
    """Distance between `value` and `expected`, in combined standard deviations."""
    source: Source

    @property
    def is_large(self) -> bool:
        """Whether the deviation is larger than the tolerances of the servos and of the assembly."""
        if self.relative:
            return bool(abs(np.log(self.value / self.expected)) > np.log1p(LARGE_RATIO))
        return abs(self.value - self.expected) > LARGE_ANGLE

    @property
    def said(self) -> str:
        """A sentence with the values and a hint on what to check."""
        spread = f"+- {self.spread:.2g}"
        if self.relative:
            wide = self.spread > LARGE_SPREAD
            spread = f"within a factor of {np.exp(self.spread):.2g}" if wide else f"+- {100.0 * self.spread:.2g} %"
        usual = _LINK if self.source == "description" else _DRIVE
        advice = next((check for kind, check in _CHECKS.items() if self.name.startswith(kind)), usual)
        return (
            f"{self.name} is {self.value:.3g} +- {self.std:.1g}, {self.deviations:.0f} standard deviations from "
            f"the {self.expected:.3g} ({spread}) {_SOURCES[self.source]}: {advice}."
        )


def conflict(
    name: str, value: float, std: float, expected: float, spread: float, *, relative: bool, source: Source | None = None
) -> Conflict | None:
    """Return the contradiction between `value` and `expected`; None if there is none.

    relative: whether `spread` is the standard deviation of the logarithm.
    """
    source = source or ("file" if kind_of(name) in _GIVEN else "servos")
    if not (np.isfinite(std) and spread > 0.0):
        return None
    if relative:
        value = max(value, 1e-300)
        away, own = np.log(value / expected), std / value
    else:
        away, own = value - expected, std
    deviations = abs(float(away)) / float(np.hypot(spread, own))
    return Conflict(name, value, std, expected, spread, relative, deviations, source) if deviations > FAR else None


def conflicts(
    names: Sequence[str], value: Array, std: Array, torque_scale_std: Mapping[str, float]
) -> tuple[Conflict, ...]:
    """Return the contradictions among the parameters of a planar arm, the largest first.

    torque_scale_std: configured relative standard deviation of the ratio of torque constants, keyed by parameter name;
    without an entry, the value in `hil.estimator.models.terms` is used.
    """
    found = []
    for name, each, error in zip(names, value.tolist(), std.tolist(), strict=True):
        term = term_of(name)
        spread = torque_scale_std.get(name, term.spread)
        if term.log_spread is not None:
            found.append(conflict(name, each, error, term.initial, term.log_spread, relative=True))
        elif isinstance(spread, float):
            ratio = term.range == "positive"
            found.append(conflict(name, each, error, term.absent, spread, relative=ratio))
    return worst_first(found)


def worst_first(found: Sequence[Conflict | None]) -> tuple[Conflict, ...]:
    """Return the entries of `found` that are not None, the largest contradiction first."""
    return tuple(sorted((each for each in found if each is not None), key=lambda each: -each.deviations))


def contradicted(found: Sequence[Conflict], explained: bool) -> str:
    """Return the most favourable verdict that the contradictions allow: "no", "with care", or "" if they allow any
    verdict.

    explained: whether the model explains the motion. If it does not, a missing effect has distorted the contradictory
    value, and presumably all others as well.
    """
    of_file = [each for each in found if each.source == "file"]
    if of_file:
        return "no" if not explained and any(each.is_large for each in of_file) else "with care"
    return "with care" if found and not explained else ""


def lowered(trust: Trust, at_most: str) -> Trust:
    """Return the less favourable of `trust` and the result of `contradicted`."""
    if at_most == "no":
        return "no"
    return "with care" if at_most and trust == "yes" else trust


def conflict_sentences(found: Sequence[Conflict], explained: bool) -> tuple[str, ...]:
    """Return the contradictions as sentences for users."""
    if not found or explained:
        return tuple(each.said for each in found)
    return (
        *(each.said for each in found),
        "The model does not explain the motion either: an effect that it lacks probably distorts these and all other "
        "values. Eliminate that effect (gear backlash, a loose screw or horn, a dragging cable, a weak supply) and "
        "identify again.",
    )
