"""Masses, centres of mass and inertias that reproduce the identified base parameters exactly.

Torque and position determine combinations such as m2 l1 c2, never a single mass. URDF and MJCF need masses, so one
distribution is chosen among all dynamically equivalent ones (m mass, c centre, J inertia about the centre, l length):

    l1      = coupling g / gravity_2, as can be checked with a ruler; for a horizontal arm, the user must give it
    link 2  first moment m2 c2 = gravity_2 / g = coupling / l1, second moment m2 c2^2 + J2 = inertia_2
    link 1  with the elbow's servo: first moment gravity_1 / g - m2 l1, second moment inertia_1 - m2 l1^2, which
            includes joint 1's rotor, because with a fixed base the two have the same effect

As in a uniform rod held at its end, m c^2 is 3/4 of each second moment, or more if a rod would be too heavy for
inertia_1. The centre of link 1 is kept within its length. This is possible if and only if inertia_1 inertia_2 >
coupling^2, which all bodies of positive mass satisfy.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from hil.arm_model import ArmModel
from hil.errors import ExportError

ROD = 0.75
"""Ratio of m c^2 to the second moment of a uniform rod about its end."""

_UNKNOWN_LENGTH = 0.1  # m, arbitrary length of a pendulum without gravity, whose mass cannot be identified


@dataclass(frozen=True)
class LinkMass:
    """One link: mass [kg], centre of mass along the link from its joint [m], inertia about that centre [kg m^2],
    length [m].
    """

    mass: float
    centre: float
    inertia: float
    length: float


def distribute(model: ArmModel, link_length: float | None = None) -> tuple[LinkMass, ...]:
    """Links from the base outwards. Raises ExportError if no links of positive mass have these parameters."""
    p = model.values
    if len(model.joints) == 1:
        _reject_length(link_length, "an arm with one joint has no second link")
        moment = p["gravity_1"] / model.gravity if model.gravity else 0.0
        _positive("inertia_1", p["inertia_1"])
        return (_link(moment, p["inertia_1"], ROD, math.inf),)
    for name in ("inertia_1", "inertia_2"):
        _positive(name, p[name])
    length, moment_2 = _elbow(model, link_length)
    share = _share_of_rod(p)
    second = _link(moment_2, p["inertia_2"], share, math.inf)
    carried = second.mass * length
    moment_1 = p["gravity_1"] / model.gravity - carried if model.gravity else 0.0
    first = _link(moment_1, p["inertia_1"] - carried * length, ROD, length)
    return LinkMass(first.mass, first.centre, first.inertia, length), second


def _elbow(model: ArmModel, link_length: float | None) -> tuple[float, float]:
    """Length of link 1 [m] and first moment of link 2 [kg m]."""
    coupling, weight = model.values["coupling"], model.values["gravity_2"]
    if not model.gravity:
        if link_length is None:
            raise ExportError(
                "A horizontal arm's parameters do not determine the length of link 1: measure it from joint to joint "
                "and give it with --link-length METRES."
            )
        return link_length, coupling / link_length
    _reject_length(link_length, "it follows from coupling * gravity / gravity_2")
    if weight == 0 or coupling / weight <= 0:
        raise ExportError(
            f"coupling = {coupling:.4g} kg m^2 and gravity_2 = {weight:.4g} N m: both must have the same sign, since "
            "their ratio times gravity is the length of link 1. Check zero_ticks and direction; excite joint 2 more."
        )
    return coupling * model.gravity / weight, weight / model.gravity


def _share_of_rod(p: Mapping[str, float]) -> float:
    """Ratio of m2 c2^2 to inertia_2: that of a rod, or more if such a rod would be too heavy for inertia_1."""
    needed = p["coupling"] ** 2 / (p["inertia_1"] * p["inertia_2"])
    if needed >= 1:
        raise ExportError(
            f"inertia_1 * inertia_2 = {p['inertia_1'] * p['inertia_2']:.4g} must be greater than coupling^2 = "
            f"{p['coupling'] ** 2:.4g} kg^2 m^4: no links of positive mass have such inertias. Check the residual in "
            "the report; use more excitation, or choose a [model] friction with more terms."
        )
    return max(ROD, 0.5 * (1 + needed))


def _link(moment: float, about_joint: float, share: float, farthest: float) -> LinkMass:
    """A link with first moment m c and second moment J + m c^2 about its joint; if possible, m c^2 is `share` times the
    second moment.
    """
    if moment == 0:
        length = farthest if math.isfinite(farthest) else _UNKNOWN_LENGTH
        return LinkMass(about_joint / length**2, 0.0, about_joint, length)
    centre = share * about_joint / moment
    if abs(centre) > farthest:
        centre = math.copysign(farthest, moment)
    return LinkMass(moment / centre, centre, about_joint - moment * centre, 2 * abs(centre))


def _positive(name: str, value: float) -> None:
    if value <= 0:
        raise ExportError(f"{name} = {value:.4g} kg m^2 is not positive: no link of positive mass can have it.")


def _reject_length(link_length: float | None, why: str) -> None:
    if link_length is not None:
        raise ExportError(f"--link-length = {link_length:g} m is not needed here: {why}. Omit the option.")
