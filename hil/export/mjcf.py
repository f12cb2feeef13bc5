"""MJCF export: bodies with masses, hinges with armature and friction, actuators commanded in the servo's own unit."""

from pathlib import Path
from xml.etree import ElementTree as ET

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.export.chain_files import export_chain_mjcf
from hil.export.left_out import left_out
from hil.export.mass_distribution import LinkMass, distribute
from hil.export.source import Source, write_text
from hil.export.xml_text import axis, comment, describe, numbers, to_text

_CARRIED = ("armature", "offset", "lag")


def export_mjcf(source: Source, path: Path) -> list[str]:
    """Write `path`; return what MJCF cannot represent. Raises ExportError if no physical masses exist."""
    model = source.model
    if isinstance(model, ChainArmModel):
        return export_chain_mjcf(source, model, path)
    links = distribute(model, source.link_length)
    left = left_out(model, _CARRIED)
    root = ET.Element("mujoco", model="arm")
    describe(root, model, left)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=numbers(0, 0, -model.gravity), timestep="0.001", integrator="implicitfast")
    parent = ET.SubElement(root, "worldbody")
    along = 0.0
    for index, link in enumerate(links):
        parent = _add_body(parent, model, index, link, along)
        along = link.length
    _add_actuators(root, model)
    write_text(path, to_text(root))
    return left


def _add_body(parent: ET.Element, model: ArmModel, index: int, link: LinkMass, along: float) -> ET.Element:
    facts, number = model.joints[index], index + 1
    body = ET.SubElement(parent, "body", name=f"link_{number}", pos=numbers(along, 0, 0))
    ET.SubElement(
        body,
        "joint",
        name=facts.name,
        type="hinge",
        axis=axis(model),
        range=numbers(*facts.position_limit),
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


def _add_actuators(root: ET.Element, model: ArmModel) -> None:
    """Add actuators controlled by a goal [A, or V in pwm mode]: gain gives torque, bias the offset, filter the drive's
    lag.
    """
    actuators = ET.SubElement(root, "actuator")
    units = ", ".join(f"{joint.name} [{joint.goal_unit}]" for joint in model.joints)
    comment(actuators, f"control is the servo's goal: {units}")
    lag = model.values.get("lag", 0.0)
    drive = {"dyntype": "filterexact", "dynprm": numbers(lag)} if lag > 0 else {}
    for number, facts in enumerate(model.joints, start=1):
        ET.SubElement(
            actuators,
            "general",
            drive,
            name=facts.name,
            joint=facts.name,
            gainprm=numbers(model.torque_per_goal(number)),
            biastype="affine",
            biasprm=numbers(-model.values[f"offset_{number}"], 0, 0),
            ctrlrange=numbers(-facts.goal_limit, facts.goal_limit),
        )
