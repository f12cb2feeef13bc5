"""Actuators of an MJCF file. They are controlled by servo goals, and have a gain, an offset and a lag."""

from xml.etree import ElementTree as ET

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.export.xml_text import comment, numbers


def add_actuators(root: ET.Element, model: ArmModel | ChainArmModel) -> None:
    """Add actuators controlled by a goal [A, or V in pwm mode]: the gain gives the torque, the bias the offset, and the
    filter the drive's lag. Each actuator is named after its joint.

    A cable is exported as the joint's own stiffness; a negative stiffness is part of the bias.
    """
    actuators = ET.SubElement(root, "actuator")
    units = ", ".join(f"{joint.name} [{joint.goal_unit}]" for joint in model.joints)
    comment(actuators, f"controls are the servos' goals: {units}")
    for number, facts in enumerate(model.joints, start=1):
        lag = model.values.get("lag", 0.0) * model.values.get(f"lag_ratio_{number}", 1.0)
        lag += model.values.get(f"lag_difference_{number}", 0.0) if lag > 0 else 0.0  # otherwise of pure delays
        drive = {"dyntype": "filterexact", "dynprm": numbers(lag)} if lag > 0 else {}
        away = min(0.0, model.values.get(f"cable_stiffness_{number}", 0.0))
        ET.SubElement(
            actuators,
            "general",
            {"name": facts.name, "joint": facts.name, **drive},
            gainprm=numbers(model.torque_per_goal(number)),
            biastype="affine",
            biasprm=numbers(-model.values.get(f"offset_{number}", 0.0), -away, 0),
            **({"ctrlrange": numbers(-facts.goal_limit, facts.goal_limit)} if facts.has_limits else {}),
        )
