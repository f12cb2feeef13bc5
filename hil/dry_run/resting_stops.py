"""Infer which joints of a spatial arm rest against their own end stops in the rest pose.

In the rest pose an arm is supported by a surface (floor, cradle, another link) or by the joints' own end stops.
Moving the arm can lift it off a surface, but an end stop holds its joint regardless of the other joints' angles.
"""

from collections.abc import Sequence

import numpy as np

from hil.clearance.space import Space
from hil.config.chain import described_arm
from hil.config.schema import Config
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.simulation.rollout import PRESSED_SHARE, ChainArms, weights
from hil.plan.chain_model import torque_limits
from hil.plan.chain_plan import PathSegment
from hil.plan.plan import Plan

NEAR_STOP_RAD = 0.14
"""A joint that rests against an end stop is at most this far [rad] from the end of its configured or described range.
"""


PASSED_RAD = 0.05
"""If a joint has moved this far [rad] beyond its rest angle, it has no end stop there, since no end stop yields that
much.
"""


def resting_stops(config: Config, arms: ChainArms, planned: Sequence[Array] = (), passed: Mask | None = None) -> Array:
    """The end stop against which each joint rests (joints,): -1 if at its smallest angle, 1 if at its largest, 0 if
    neither.

    A joint is assumed to rest against an end stop if its rest pose is near the end of its range, nothing else touches
    the part of the arm that it moves, and gravity does not pull it away from the stop. A joint that a recording or a
    planned path takes beyond its rest angle is assumed to have no end stop there. planned: positions of the planned
    paths, each (joints, samples) [rad]. passed: whether each joint has been below its rest pose (row 0) and above it
    (row 1), as returned by `passed_rest`. Raises ArmFileError.
    """
    rest = np.array(config.arm.rest_pose)
    low, high = _ends(config, rest)
    side = np.where(high < low, 1.0, -1.0)
    side[np.minimum(low, high) > NEAR_STOP_RAD] = 0.0
    side[Space.of(config).is_touched] = 0.0
    pulled = side * weights(arms, rest).mean(axis=0)
    side[pulled > PRESSED_SHARE * torque_limits(config)] = 0.0
    for beyond in (passed, *(passed_rest(config, path.T) for path in planned)):
        if beyond is not None:
            side[np.where(side < 0.0, beyond[0], beyond[1])] = 0.0
    return side


def passed_rest(config: Config, position: Array) -> Mask:
    """Whether each joint was ever below (row 0) or above (row 1) its rest pose in a recording (samples, joints)."""
    away = position - np.array(config.arm.rest_pose)
    away = np.where(np.isfinite(away), away, 0.0)
    found: Mask = np.stack((away.min(axis=0) < -PASSED_RAD, away.max(axis=0) > PASSED_RAD))
    return found


def planned_paths(plan: Plan) -> list[Array]:
    """Positions of all paths of a plan, with their transitions, each (joints, samples) [rad]."""
    return [path.position for each in plan.segments if isinstance(each, PathSegment) for path in each.paths]


def said_of_stops(config: Config, side: Array) -> str:
    """Name the joints assumed to rest against end stops, and say what happens if they do not; "" if there are none."""
    found = []
    for joint, each, rest in zip(config.joints, side.tolist(), config.arm.rest_pose, strict=True):
        if each:
            room = max(0.0, each * (joint.position_limit[each > 0.0] - rest))
            found.append(f"{joint.name!r} ({room:.2f} rad)")
    if not found:
        return ""
    return (
        "Nothing in the description supports these joints in the rest pose, so each is assumed to rest against its "
        f"own end stop: {', '.join(found)}. If something else supports them, name it in [clearance] (floor, "
        "boxes). A joint that nothing holds may sag by up to the angle in brackets before position_limit stops the arm."
    )


def _ends(config: Config, rest: Array) -> tuple[Array, Array]:
    """Distance on each side from the rest pose to the nearer of the configured and the described limit (joints,)."""
    limits = np.array([joint.position_limit for joint in config.joints])
    ends = np.abs(limits - rest[:, None])
    for row, joint, at in zip(ends, described_arm(config).joints, rest, strict=True):
        if joint.limits is not None and joint.limits[0] < joint.limits[1]:
            row[:] = np.minimum(row, np.abs(np.array(joint.limits) - at))
    return ends[:, 0], ends[:, 1]
