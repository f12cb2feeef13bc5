"""Warnings about the configuration and the description of an arm. They do not prevent an experiment."""

import math
from collections.abc import Iterator
from itertools import accumulate

from hil.clearance.space import Space
from hil.config.chain import described_arm, doubted_gravity, doubted_inertias, doubted_limits
from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.config.varying_delay import varying_delay
from hil.drivers.servo_prior import servo_prior
from hil.next_step import command

_LEANS = 0.35
"""Absolute cosine of a link's angle at rest above which gravity clearly pulls the link to one side."""


def doubts(config: Config) -> Iterator[str]:
    """Yield one sentence per warning. Raises ArmFileError."""
    for joint in config.joints:
        if said := _weak(joint):
            yield said
        if said := _same_direction(config, joint):
            yield said
    if said := varying_delay(config):
        yield said
    if not config.is_chain:
        yield from _leaning(config)
        return
    arm = described_arm(config)
    yield from doubted_inertias(arm)
    yield from doubted_gravity(config)
    yield from doubted_limits(config)
    space = Space.of(config)
    for doubt in space.shapes.doubts:
        yield f"{arm.path.name}: {doubt}"
    yield from unchecked(space)


def _leaning(config: Config) -> Iterator[str]:
    """Yield a warning if a planar arm's links neither hang nor stand at rest: something must hold them there."""
    if config.arm.gravity == 0.0 or config.stabiliser is not None:
        return
    angles = zip(config.joints, accumulate(config.arm.rest_pose), strict=True)
    leaning = next(((joint, angle) for joint, angle in angles if abs(math.cos(angle)) > _LEANS), None)
    if leaning is None:
        return
    joint, angle = leaning
    away = abs(math.degrees(math.remainder(angle + math.pi / 2, math.tau)))
    yield (
        f"At arm.rest_pose, the link of joint {joint.name!r} is {away:.0f} "
        "degrees away from hanging straight down, so without torque only friction or an end stop holds it there. "
        "The model of a planar arm includes no end stops: if the arm rests against one, change the mounting so that it "
        "hangs freely, or describe the arm with a URDF, in which case joints may rest against end stops."
    )


def unchecked(space: Space) -> Iterator[str]:
    """Yield one sentence per pair of links that is not fully checked for contact."""
    for first, second in space.as_built:
        yield (
            f"Some parts of {first!r} and {second!r} are closer than clearance.margin in nearly every pose, apparently "
            "by design. The distance between these parts is not checked; all other distances are."
        )


def near_by_design(space: Space) -> Iterator[str]:
    """Yield one sentence that lists all pairs of links with parts that need no margin; nothing if there are none."""
    if space.near:
        pairs = ", ".join(f"{first} and {second}" for first, second in space.near)
        yield f"Parts of these links are near each other by design; they must not touch, but need no margin: {pairs}."


def _same_direction(config: Config, joint: JointConfig) -> str:
    """Return a warning if both servos of a joint have the same configured direction, which is rarely right; otherwise
    "".
    """
    if len(joint.ids) == 1 or len(set(joint.directions)) > 1:
        return ""
    (first, second), sign = joint.ids, joint.direction
    given = list(joint.directions) if isinstance(joint.turns, list) else sign
    return (
        f"direction = {given} means that IDs {first} and {second} of joint {joint.name!r} turn the same way. Servos "
        f"that face each other turn in opposite directions: they need direction = [{sign}, {-sign}]; otherwise they "
        f"work against each other. {_how_to_compare(config)}"
    )


def _how_to_compare(config: Config) -> str:
    if config.arm.urdf is not None:
        guided = command("pose", config.path, "--guide")
        return (
            f"Only motion shows which direction is right: `{guided}` compares both servos while you turn the joint by "
            "hand."
        )
    return (
        "Only motion shows which direction is right: with torque off, turn the joint by hand and compare the Present "
        "Positions of both servos in DYNAMIXEL Wizard 2.0."
    )


def _weak(joint: JointConfig) -> str:
    """Return a warning if the limit keeps a joint's torque below its servos' typical friction; otherwise ""."""
    friction = len(joint.ids) * servo_prior(joint.joint.servo).coulomb.median
    torque = joint.goal_limit * joint.torque_per_goal
    if torque > friction:
        return ""
    unit = joint.drive_mode.goal_unit
    return (
        f"{joint.goal_limit_name} of joint {joint.name!r} = {joint.goal_limit:g} {unit} limits its torque to "
        f"{torque:.2g} N m, but its servos' typical dry friction is {friction:.2g} N m. The joint probably would not "
        f"move. It needs about {2.0 * friction / joint.torque_per_goal:.2g} {unit} to move without a load, and more to "
        "lift one."
    )
