"""URDF export: links with masses, and joints with limits, viscous friction and Coulomb friction."""

from pathlib import Path
from xml.etree import ElementTree as ET

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.export.chain_files import export_chain_urdf
from hil.export.left_out import left_out, torque_constants
from hil.export.mass_distribution import LinkMass, distribute
from hil.export.source import Source
from hil.export.xml_text import axis, describe, numbers, to_text
from hil.whole_file import write_whole

STANDARD_GRAVITY = 9.81


def export_urdf(source: Source, path: Path) -> list[str]:
    """Write `path`; return what URDF cannot represent. Raises ExportError if no physically possible
    masses have the identified parameters.
    """
    model = source.model
    if isinstance(model, ChainArmModel):
        return export_chain_urdf(source, model, path)
    links = distribute(model, source.link_length)
    left = [*left_out(model), *torque_constants(model)]
    if model.gravity not in (0.0, STANDARD_GRAVITY):
        left.append(f"gravity = {model.gravity:g} m/s^2, on which the masses are based: set it in the physics engine")
    root = ET.Element("robot", name="arm")
    describe(root, model, left)
    ET.SubElement(root, "link", name="base")
    for index, link in enumerate(links):
        _add_link(root, index + 1, link)
        _add_joint(root, model, index, links[index - 1].length if index else 0.0)
    write_whole(path, to_text(root))
    return left


def _add_link(root: ET.Element, number: int, link: LinkMass) -> None:
    element = ET.SubElement(root, "link", name=f"link_{number}")
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(link.centre, 0, 0))
    ET.SubElement(inertial, "mass", value=numbers(link.mass))
    # Only the inertia about the joint axis was identified; the others are set equal, which every engine accepts.
    moments = dict.fromkeys(("ixx", "iyy", "izz"), numbers(link.inertia))
    products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ET.SubElement(inertial, "inertia", {**moments, **products})
    visual = ET.SubElement(element, "visual")
    ET.SubElement(visual, "origin", xyz=numbers(link.length / 2, 0, 0), rpy=numbers(0, 1.5707963267948966, 0))
    geometry = ET.SubElement(visual, "geometry")
    ET.SubElement(geometry, "cylinder", radius="0.01", length=numbers(link.length))


def _add_joint(root: ET.Element, model: ArmModel, index: int, along: float) -> None:
    facts, number = model.joints[index], index + 1
    element = ET.SubElement(root, "joint", name=facts.name, type="revolute" if facts.has_limits else "continuous")
    ET.SubElement(element, "parent", link=f"link_{index}" if index else "base")
    ET.SubElement(element, "child", link=f"link_{number}")
    ET.SubElement(element, "origin", xyz=numbers(along, 0, 0))
    ET.SubElement(element, "axis", xyz=axis(model))
    if facts.has_limits:
        low, high = facts.position_limit
        ET.SubElement(
            element,
            "limit",
            lower=numbers(low),
            upper=numbers(high),
            velocity=numbers(facts.velocity_limit),
            effort=numbers(facts.goal_limit * model.torque_per_goal(number)),
        )
    friction = {"damping": f"viscous_{number}", "friction": f"coulomb_{number}"}
    ET.SubElement(element, "dynamics", {key: numbers(model.values[name]) for key, name in friction.items()})
