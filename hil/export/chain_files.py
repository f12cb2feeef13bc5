"""URDF and MJCF of an identified spatial arm.

The URDF is the one used for the identification: names, frames, limits and meshes are kept; inertias, and the
damping and friction of the arm's joints, are replaced. The MJCF is written from the URDF's geometry.
"""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from hil import __version__
from hil.chain_model import ChainArmModel
from hil.clearance.shapes import Solid, solids_of
from hil.description.arm import Body
from hil.description.files import is_mjcf
from hil.description.urdf import parse_urdf
from hil.estimator.chain.model.tilt import TILT
from hil.export.actuators import add_actuators
from hil.export.chain_links import ChainLinks, chain_links, without_movable
from hil.export.left_out import base_orientation, chain_left_out, torque_constants
from hil.export.source import Source
from hil.export.xml_text import comment, numbers, to_text
from hil.whole_file import write_whole

_IN_MJCF = ("offset", "lag", "lag_ratio", *TILT)


def export_chain_urdf(source: Source, model: ChainArmModel, path: Path) -> list[str]:
    """Write the URDF file `path`; return what URDF cannot represent. Raises ExportError."""
    found = chain_links(source, model)
    if is_mjcf(found.path):
        return _export_own_urdf(found, model, path)
    root = parse_urdf(found.path)
    links = {element.get("name"): element for element in root.findall("link")}
    joints = {element.get("name"): element for element in root.findall("joint")}
    reduced: list[str] = []
    for index, (joint, body) in enumerate(zip(found.arm.joints, found.bodies, strict=True)):
        link = links[joint.link]
        own, share = without_movable(joint, body)
        _replace_inertial(link, own)
        apart = joint.movable if share > 0.0 else ()
        merged = [name for name in joint.fixed if name not in apart]
        if merged:
            comment(link, f"includes the inertia of these links, which are fixed to this one: {', '.join(merged)}")
            for name in merged:
                _remove(links[name], "inertial")
        if apart:
            comment(link, f"excludes links moved by held joints, whose inertia was not identified: {', '.join(apart)}")
        if share < 1.0:
            reduced.append(
                f"the full inertia that the description gives for {', '.join(joint.movable)}; the file has "
                f"{100 * share:.2g} % of it, because more would leave no physically possible body for {joint.link}"
            )
            for name in apart:
                _scale_inertial(links[name], share)
        dynamics = joints[joint.name].find("dynamics")
        if dynamics is None:
            dynamics = ET.SubElement(joints[joint.name], "dynamics")
        dynamics.set("damping", numbers(model.values[f"viscous_{index + 1}"]))
        dynamics.set("friction", numbers(model.values[f"coulomb_{index + 1}"]))
    rotors = [f"armature of {j.name} = {a:.6g} kg m^2" for j, a in zip(found.arm.joints, found.armature, strict=True)]
    left = [*found.left_out, *base_orientation(model), *rotors, *reduced]
    left += [*chain_left_out(model), *torque_constants(model)]
    _describe(root, model, found, left)
    write_whole(path, to_text(root))
    return left


def _export_own_urdf(found: ChainLinks, model: ChainArmModel, path: Path) -> list[str]:
    """Write the URDF of an arm described in MJCF, with its joints, frames and body names."""
    root = ET.Element("robot", name=found.path.stem)
    rotors = [f"armature of {j.name} = {a:.6g} kg m^2" for j, a in zip(found.arm.joints, found.armature, strict=True)]
    left = [*found.left_out, "the MJCF's shapes", *base_orientation(model), *_held(found), *rotors]
    left += [*chain_left_out(model), *torque_constants(model)]
    _describe(root, model, found, left)
    ET.SubElement(root, "link", name=found.arm.base)
    parent = found.arm.base
    for index, (joint, body) in enumerate(zip(found.arm.joints, found.bodies, strict=True)):
        _replace_inertial(ET.SubElement(root, "link", name=joint.link), body)
        facts = model.joints[index]
        element = ET.SubElement(root, "joint", name=joint.name, type="revolute" if facts.has_limits else "continuous")
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=joint.link)
        ET.SubElement(element, "origin", xyz=numbers(*joint.translation), rpy=numbers(*_roll_pitch_yaw(joint.rotation)))
        ET.SubElement(element, "axis", xyz=numbers(*joint.axis))
        if facts.has_limits:
            low, high = facts.position_limit
            effort = facts.goal_limit * model.torque_per_goal(index + 1)
            bounds = {"lower": low, "upper": high, "velocity": facts.velocity_limit, "effort": effort}
            ET.SubElement(element, "limit", {key: numbers(value) for key, value in bounds.items()})
        friction = {"damping": f"viscous_{index + 1}", "friction": f"coulomb_{index + 1}"}
        ET.SubElement(element, "dynamics", {key: numbers(model.values[name]) for key, name in friction.items()})
        parent = joint.link
    write_whole(path, to_text(root))
    return left


def export_chain_mjcf(source: Source, model: ChainArmModel, path: Path) -> list[str]:
    """Write the MJCF file `path`; return what MJCF cannot represent. Raises ExportError."""
    found = chain_links(source, model)
    root = ET.Element("mujoco", model=found.path.stem)
    solids = solids_of(found.arm)
    left = [
        *found.left_out,
        *_not_in_mjcf(found, solids),
        *_held(found),
        *chain_left_out(model, _IN_MJCF),
    ]
    _describe(root, model, found, left)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=numbers(*model.base_gravity), timestep="0.001", integrator="implicitfast")
    parent = ET.SubElement(root, "worldbody")
    _add_geoms(parent, [solid for solid in solids if solid.link == 0])
    for index, (joint, body) in enumerate(zip(found.arm.joints, found.bodies, strict=True)):
        number, facts = index + 1, model.joints[index]
        limits = facts.position_limit if facts.has_limits else joint.limits
        place = {"pos": numbers(*joint.translation), "quat": numbers(*_quaternion(joint.rotation))}
        parent = ET.SubElement(parent, "body", {"name": joint.link, **place})
        ET.SubElement(
            parent,
            "joint",
            {} if limits is None else {"range": numbers(*limits)},
            name=joint.name,
            type="hinge",
            axis=numbers(*joint.axis),
            armature=numbers(found.armature[index]),
            damping=numbers(model.values[f"viscous_{number}"]),
            frictionloss=numbers(model.values[f"coulomb_{number}"]),
        )
        i = body.inertia
        full = numbers(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
        ET.SubElement(parent, "inertial", pos=numbers(*body.centre), mass=numbers(body.mass), fullinertia=full)
        _add_geoms(parent, [solid for solid in solids if solid.link == number])
    add_actuators(root, model)
    write_whole(path, to_text(root))
    return left


def _held(found: ChainLinks) -> list[str]:
    if not found.arm.held:
        return []
    with_links = [joint.link for joint in found.arm.joints if joint.movable]
    carried = f"; the links that they move are part of {', '.join(with_links)}" if with_links else ""
    joints, were = ("joint", "was") if len(found.arm.held) == 1 else ("joints", "were")
    return [f"the {joints} {', '.join(found.arm.held)}, which {were} held during the identification{carried}"]


def _not_in_mjcf(found: ChainLinks, solids: Sequence[Solid]) -> list[str]:
    is_known = not is_mjcf(found.path)
    meshes = [f"the {'URDF' if is_known else 'MJCF'}'s meshes"] if any(not solid.size for solid in solids) else []
    if not is_known:
        return [*meshes, "the sites, sensors and actuators of the file that described the arm"]
    return [*meshes, "the URDF's effort limits and fixed frames"]


def _add_geoms(body: ET.Element, solids: Sequence[Solid]) -> None:
    """Add the boxes, cylinders, capsules and spheres of a link; they collide with nothing unless contype is set."""
    for solid in solids:
        if solid.size:
            place = {"pos": numbers(*solid.translation), "quat": numbers(*_quaternion(solid.rotation))}
            shape = {"type": solid.kind, "size": numbers(*solid.size), **place}
            ET.SubElement(body, "geom", {**shape, "contype": "0", "conaffinity": "0"})


def _describe(root: ET.Element, model: ChainArmModel, found: ChainLinks, left: list[str]) -> None:
    which = "dynamically equivalent" if found.is_exact else "physically consistent, but NOT dynamically equivalent"
    words = [
        f"Inertias, damping and friction identified by hil {__version__}; everything else is from {found.path.name}.",
        f"The link inertias are the {which} ones closest to that file's. Only the following combinations were "
        "identified:",
        *(f"{model.groups[name]} = {model.values[name]!r} +- {model.stds[name]:.1e}" for name in model.groups),
        *(f"Not representable in this format: {sentence}" for sentence in left),
    ]
    for position, text in enumerate(words):
        root.insert(position, ET.Comment(f" {text.replace('--', '- -')} "))


def _replace_inertial(link: ET.Element, body: Body) -> None:
    _remove(link, "inertial")
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(*body.centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=numbers(body.mass))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: numbers(body.inertia[at]) for key, at in names.items()})


def _scale_inertial(link: ET.Element, share: float) -> None:
    comment(link, f"{share:g} of the described mass and inertia: the full values would leave none for the parent link")
    for element in (*link.findall("inertial/mass"), *link.findall("inertial/inertia")):
        for key, value in element.attrib.items():
            element.set(key, numbers(share * float(value)))


def _remove(parent: ET.Element, tag: str) -> None:
    for element in parent.findall(tag):
        parent.remove(element)


def _roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_euler("xyz"))


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Convert a rotation matrix (3, 3) to a quaternion w, x, y, z (4,)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])
