"""Sentences about the uncertainty that the torque constants cause in a result, for terminal and report."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from hil.config.joint import JointConfig
from hil.drivers.servo_model import Mode
from hil.results.parts import Quantity

RATIO = "torque_scale"


class Driven(Protocol):
    """A joint as described by the configuration or by a model."""

    @property
    def name(self) -> str: ...

    @property
    def torque_per_goal(self) -> float:
        """Torque per goal at the output shaft: N m/A, or N m/V in pwm mode."""

    @property
    def torque_per_goal_std(self) -> float: ...


def torque_constants_said(joints: Sequence[Driven], extra: Mapping[str, Quantity]) -> str:
    """Sentences on how the values depend on the torque constants and how well these are known.

    extra: the result's terms besides the base parameters. If they include the ratios of the torque constants, only the
    first constant remains uncertain.
    """
    exact = [joint.name for joint in joints if not joint.torque_per_goal_std]
    silent = (
        ""
        if not exact
        else f"For {', '.join(exact)}, no uncertainty of the torque constant is given (torque_constant_std, or "
        "torque_per_volt_std in PWM mode): servos of the same model differ by about 10 %, so every value may be off "
        "by as much."
    )
    unsure = [
        f"{joint.name} {100 * joint.torque_per_goal_std / joint.torque_per_goal:.2g} %"
        for joint in joints
        if joint.torque_per_goal_std
    ]
    ratios = [(joint, extra[f"{RATIO}_{n}"]) for n, joint in enumerate(joints, 1) if f"{RATIO}_{n}" in extra]
    if not ratios:
        known = (
            "Every value also scales with its joint's torque constant, whose relative uncertainty is: "
            f"{', '.join(unsure)}."
        )
        return " ".join(sentence for sentence in (known if unsure else "", silent) if sentence)
    first = joints[0]
    given = ", ".join(f"{joint.name} gives {ratio.value:.5g} +- {ratio.std:.1g}" for joint, ratio in ratios)
    its = "its torque constant implies" if len(ratios) == 1 else "their torque constants imply"
    found = (
        f"Relative to {first.name}, {given} times the torque that {its}. Every value scales only with the torque "
        f"constant of {first.name}"
    )
    if not first.torque_per_goal_std:
        return f"{found}, whose uncertainty is not given."
    return f"{found}, known to {100 * first.torque_per_goal_std / first.torque_per_goal:.2g} %."


def by_voltage_said(joints: Sequence[JointConfig]) -> str:
    """A sentence on what viscous friction includes for voltage-driven joints; empty for others."""
    if all(joint.drive_mode is not Mode.PWM for joint in joints):
        return ""
    return "Driven by voltage: the viscous friction includes the motor's back-EMF."
