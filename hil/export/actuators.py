"""Actuators of an MJCF file: controlled by the servos' goals, with their gain, offset and lag."""

from xml.etree import ElementTree as ET

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.export.xml_text import comment, numbers


def add_actuators(root: ET.Element, model: ArmModel | ChainArmModel) -> None:
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
            biasprm=numbers(-model.values.get(f"offset_{number}", 0.0), 0, 0),
            ctrlrange=numbers(-facts.goal_limit, facts.goal_limit),
        )
