"""Sentences about the uncertainty that the torque constants add to a result, for the terminal and the report."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, Protocol

from hil.config.joint import USUAL_TORQUE_SPREAD, JointConfig
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array
from hil.estimator.models.conflicts import Conflict
from hil.results.parts import Quantity

RATIO = "torque_scale"
USUAL_RATIO_STD = math.hypot(USUAL_TORQUE_SPREAD, USUAL_TORQUE_SPREAD)
CONTRADICTORY = 2.0  # combined standard deviations of the torque constants and of the ratio
COLUMNS_APART = 1.0
"""Relative standard deviation assumed for the ratio of two torque columns with unknown scales."""
Source = Literal["constant", "column"]
"""Where a joint's torque comes from: its torque constant, or a column of a recording."""
_STATES: dict[Source, str] = {"constant": "torque constants", "column": "torque columns"}
_CHECK: dict[Source, str] = {
    "constant": "check the model and the torque_constant of both joints, or measure the constants with `hil calibrate`",
    "column": "check the unit, the scale, the gear ratio and the torque constant behind both columns",
}


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
    """Sentences about how the values depend on the torque constants and how well these are known.

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
        f"{100 * joint.torque_per_goal_std / joint.torque_per_goal:.2g} % ({joint.name})"
        for joint in joints
        if joint.torque_per_goal_std
    ]
    names = [joint.name for joint in joints]
    ratios = [(joint, ratio) for joint, _, ratio in _ratios(names, extra)]
    if not ratios:
        known = (
            "Every value is also proportional to its joint's torque constant, which is known to within "
            f"{', '.join(unsure)}."
        )
        return " ".join(sentence for sentence in (known if unsure else "", silent) if sentence)
    first = joints[0]
    given = capitalised(_relative(first.name, ratios, "constant"))
    found = f"{given}. All values scale with the torque constant of {first.name} alone"
    if not first.torque_per_goal_std:
        return f"{found}, whose uncertainty is not given."
    return f"{found}, which is known to within {100 * first.torque_per_goal_std / first.torque_per_goal:.2g} %."


def ratios_of(names: Sequence[str], value: Array, std: Array) -> dict[str, Quantity]:
    """The ratios of the torque constants among the parameters `names`."""
    return {
        name: Quantity(float(each), float(error), "1")
        for name, each, error in zip(names, value, std, strict=True)
        if name.startswith(RATIO)
    }


def contradictions(
    joints: Sequence[str],
    extra: Mapping[str, Quantity],
    ratio_std: Mapping[str, float],
    source: Source,
    known: Sequence[Conflict] = (),
) -> tuple[str, ...]:
    """A sentence for each joint whose torque disagrees with the first joint's by more than the uncertainty of the
    torque constants allows.

    joints: names. extra: terms of a result that include the ratios, if there are any. ratio_std: relative standard
    deviation of the ratio of the torque constants, by parameter; where it is not given, the spread among servos of one
    model is assumed. known: contradictions that are already reported.
    """
    said = {each.name for each in known}
    found = []
    for joint, name, ratio in _ratios(joints, extra):
        apart = COLUMNS_APART if source == "column" and name not in ratio_std else CONTRADICTORY
        spread = ratio_std.get(name) or USUAL_RATIO_STD
        value = max(ratio.value, 1e-6)
        if name in said or not abs(math.log(value)) > math.hypot(apart * spread, CONTRADICTORY * ratio.std / value):
            continue
        found.append(
            f"The {_STATES[source]} of {joints[0]} and {joint} disagree by a factor of "
            f"{max(value, 1.0 / value):.3g}: {_relative(joints[0], [(joint, ratio)], source)}, whereas the ratio "
            f"of torque constants is uncertain by only {100 * spread:.2g} %. The values of all joints are relative "
            f"to the torque of {joints[0]} and share its error: {_CHECK[source]}."
        )
    return tuple(found)


def ratios_said(
    joints: Sequence[str], extra: Mapping[str, Quantity], source: Source, without: Sequence[str]
) -> tuple[str, ...]:
    """A sentence about the ratios of the torques; () if the sentences in `without` already give them."""
    ratios = [(joint, ratio) for joint, _, ratio in _ratios(joints, extra)]
    if not ratios or without:
        return ()
    stated = capitalised(_relative(joints[0], ratios, source))
    return (f"{stated}. The values of all joints are relative to the torque of {joints[0]}.",)


def capitalised(sentence: str) -> str:
    """Return a sentence with its first letter in upper case."""
    return sentence[0].upper() + sentence[1:]


def _ratios(joints: Sequence[str], extra: Mapping[str, Quantity]) -> list[tuple[str, str, Quantity]]:
    names = [(joint, f"{RATIO}_{number}") for number, joint in enumerate(joints, 1)]
    return [(joint, name, extra[name]) for joint, name in names if name in extra]


def _relative(first: str, ratios: Sequence[tuple[str, Quantity]], source: Source) -> str:
    given = ", ".join(f"{joint} gives {ratio.value:.5g} +- {ratio.std:.1g}" for joint, ratio in ratios)
    one = len(ratios) == 1
    if source == "column":
        stated = "its column states" if one else "their columns state"
    else:
        stated = "its torque constant implies" if one else "their torque constants imply"
    return f"relative to {first}, {given} times the torque that {stated}"


def by_voltage_said(joints: Sequence[JointConfig]) -> str:
    """A sentence about the back-EMF in the viscous friction of voltage-driven joints; "" if there are none."""
    if all(joint.drive_mode is not Mode.PWM for joint in joints):
        return ""
    return "The viscous friction of voltage-driven joints includes the motor's back-EMF."
