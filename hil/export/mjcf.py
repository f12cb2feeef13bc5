"""MJCF export: bodies with masses, hinges with armature and friction, and actuators commanded in the servos' units."""

from pathlib import Path
from xml.etree import ElementTree as ET

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.export.actuators import add_actuators
from hil.export.chain_files import export_chain_mjcf
from hil.export.left_out import left_out
from hil.export.mass_distribution import LinkMass, distribute
from hil.export.source import Source
from hil.export.xml_text import axis, describe, numbers, to_text
from hil.whole_file import write_whole

_CARRIED = ("armature", "offset", "lag", "cable_stiffness")


def export_mjcf(source: Source, path: Path) -> list[str]:
    """Write `path`; return what MJCF cannot represent. Raises ExportError if no physically possible
    masses have the identified parameters.
    """
    model = source.model
    if isinstance(model, ChainArmModel):
        return export_chain_mjcf(source, model, path)
    links = distribute(model, source.link_length)
    left = left_out(model, (*_CARRIED, "lag_difference") if "lag" in model.values else _CARRIED)
    root = ET.Element("mujoco", model="arm")
    describe(root, model, left)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=numbers(0, 0, -model.gravity), timestep="0.001", integrator="implicitfast")
    parent = ET.SubElement(root, "worldbody")
    along = 0.0
    for index, link in enumerate(links):
        parent = _add_body(parent, model, index, link, along)
        along = link.length
    add_actuators(root, model)
    write_whole(path, to_text(root))
    return left


def _add_body(parent: ET.Element, model: ArmModel, index: int, link: LinkMass, along: float) -> ET.Element:
    facts, number = model.joints[index], index + 1
    body = ET.SubElement(parent, "body", name=f"link_{number}", pos=numbers(along, 0, 0))
    cable = model.values.get(f"cable_stiffness_{number}", 0.0)
    spring = {"stiffness": numbers(cable), "springref": "0"} if cable > 0 else {}
    ET.SubElement(
        body,
        "joint",
        spring | ({"range": numbers(*facts.position_limit)} if facts.has_limits else {}),
        name=facts.name,
        type="hinge",
        axis=axis(model),
        # The inertia of link 1 includes the rotor of joint 1.
        armature=numbers(model.values.get(f"armature_{number}", 0.0)),
        damping=numbers(model.values[f"viscous_{number}"]),
        frictionloss=numbers(model.values[f"coulomb_{number}"]),
    )
    # Only the inertia about the joint axis was identified; the others are set equal, which every engine accepts.
    inertia = numbers(*(link.inertia,) * 3)
    ET.SubElement(body, "inertial", pos=numbers(link.centre, 0, 0), mass=numbers(link.mass), diaginertia=inertia)
    seen = {"type": "capsule", "size": "0.01", "fromto": numbers(0, 0, 0, link.length, 0, 0)}
    ET.SubElement(body, "geom", seen, contype="0", conaffinity="0")
    return body
