"""What a robot description cannot represent: reported in the terminal and in the file, never dropped silently."""

from hil.arm_model import ArmModel
from hil.estimator.models.terms import term_of

_SAID_ELSEWHERE = ("inertia", "coupling", "gravity", "viscous", "coulomb", "torque_scale")
"""Terms that every robot description can represent or that `torque_constants` reports."""


def left_out(model: ArmModel, carried: tuple[str, ...] = ()) -> list[str]:
    """One sentence per model parameter that the format cannot represent, except those in `carried`."""
    said = []
    for name, value in model.values.items():
        term = term_of(name)
        if term.name not in (*_SAID_ELSEWHERE, *carried):
            unit = "" if term.unit == "1" else f" {term.unit}"
            said.append(f"{name} = {value:.6g}{unit} ({term.meaning})")
    return said


def torque_constants(model: ArmModel) -> list[str]:
    """One sentence per joint about its torque constant."""
    return [
        f"torque per goal of {joint.name} = {model.torque_per_goal(number):.6g} N m/{joint.goal_unit}"
        for number, joint in enumerate(model.joints, start=1)
    ]
