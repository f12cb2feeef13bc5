"""Warnings about what a URDF says: values that no real arm is likely to have, and motion that the model leaves out."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Container, Iterator, Mapping, Sequence

import numpy as np

from hil.description.arm import ArmJoint

_TURN_RAD = 2.0 * math.pi
_BULKY = 2.0
"""Radius of gyration, relative to the size of a link, above which an inertia is implausible; that of a uniform rod is
0.29 times its length.
"""
_SMALL_M = 0.1
"""Smallest size that is assumed for a link [m]."""


def impossible_inertias(arm: Sequence[ArmJoint], physical: Mapping[str, bool]) -> Iterator[str]:
    """Yield one sentence per link whose inertia no mass distribution can have.

    physical: whether the inertia of each link in the file is possible, by name.
    """
    for each in arm:
        if not physical[each.link] or not each.body.is_physical:
            yield f'link "{each.link}": no mass distribution can have this inertia; it is used only as an initial guess'


def without_inertia(root: ET.Element, links: Container[str | None]) -> Iterator[str]:
    """Yield one sentence per link in `links` that has a mass but no inertia."""
    for element in root.findall("link"):
        inertial = element.find("inertial")
        mass = None if inertial is None else inertial.find("mass")
        if inertial is None or mass is None or element.get("name") not in links:
            continue
        inertia = inertial.find("inertia")
        is_given = inertia is not None and any(float(value) for key, value in inertia.items() if key[:1] == "i")
        if not is_given and float(mass.get("value", "nan")) > 0.0:
            how = "no <inertia>" if inertia is None else "an <inertia> of zero"
            yield (
                f'link "{element.get("name")}" has a mass but {how}, so it counts as a point '
                "mass, which is used only as an initial guess"
            )


def bulky_links(arm: Sequence[ArmJoint]) -> Iterator[str]:
    """Yield one sentence per link whose radius of gyration is far larger than the link, as that of a placeholder is."""
    for number, each in enumerate(arm):
        following = arm[number + 1].translation if number + 1 < len(arm) else np.zeros(3)
        size = max(float(np.linalg.norm(following)), 2.0 * float(np.linalg.norm(each.body.centre)), _SMALL_M)
        about_centre = 0.5 * float(np.trace(each.body.inertia))
        gyration = math.sqrt(max(about_centre, 0.0) / each.body.mass)
        if gyration > _BULKY * size:
            yield (
                f'link "{each.link}" is about {size:.2g} m long, but its inertia is that of {each.body.mass:.3g} kg at '
                f"{gyration:.2g} m from its centre of mass. If its mass and inertia are placeholders, replace them "
                "with estimates, since they determine how large the first motion is"
            )


def angles_in_degrees(root: ET.Element) -> Iterator[str]:
    """Yield one sentence per joint or link with an angle in an origin that exceeds a full turn."""
    for element in (*root.findall("joint"), *root.findall("link")):
        for origin in element.iter("origin"):
            text = origin.get("rpy", "0 0 0")
            if max(abs(float(part)) for part in text.split()) > _TURN_RAD:
                yield (
                    f'{element.tag} "{element.get("name")}" has an origin with rpy="{text}", which is more than a '
                    "full turn: are these degrees? URDF uses radians"
                )


def left_out_mimics(mimics: Mapping[str, str | None], held: Sequence[str], names: Container[str]) -> Iterator[str]:
    """Yield one sentence per held joint that in fact follows one of the arm's joints.

    mimics: the joint that each joint mimics, by name. held: joints assumed to be held at zero. names: the arm's joints.
    """
    for joint in held:
        leader = mimics[joint]
        if leader is not None and leader in names:
            yield (
                f'joint "{joint}" mimics "{leader}", so its link moves with the arm, but the model assumes that it is '
                "held at zero: the parameters of the links that carry it are distorted"
            )
