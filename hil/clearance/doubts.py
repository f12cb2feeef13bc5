"""Warnings about the configuration and the description of an arm, which do not prevent an experiment."""

from collections.abc import Iterator

from hil.clearance.space import Space
from hil.config.chain import described_arm, doubted_inertias, doubted_limits
from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.servo_prior import servo_prior


def doubts(config: Config) -> Iterator[str]:
    """Yield one sentence per doubt. Raises ArmFileError."""
    for joint in config.joints:
        if said := _weak(joint):
            yield said
    if not config.is_chain:
        return
    arm = described_arm(config)
    yield from doubted_inertias(arm)
    yield from doubted_limits(config)
    for doubt in Space.of(config).shapes.doubts:
        yield f"{arm.path.name}: {doubt}"


def _weak(joint: JointConfig) -> str:
    """Say that a joint's limit gives less torque than its servos' friction typically holds; "" if it gives more."""
    friction = len(joint.ids) * servo_prior(joint.joint.servo).coulomb.median
    torque = joint.goal_limit * joint.torque_per_goal
    if torque > friction:
        return ""
    unit = joint.drive_mode.goal_unit
    return (
        f"{joint.goal_limit_name} of joint {joint.name!r} = {joint.goal_limit:g} {unit} allows at most {torque:.2g} "
        f"N m, no more than the typical dry friction of its servos, {friction:.2g} N m: it probably would not move. "
        f"About {2.0 * friction / joint.torque_per_goal:.2g} {unit} move it without a load, more lift one."
    )
