"""The pose in which a spatial arm lies before a run. The motion starts and ends there rather than exactly at
arm.rest_pose.

If the motion started at arm.rest_pose, the stabiliser would pull the arm there as soon as torque is switched on,
perhaps against an end stop.
"""

from collections.abc import Sequence

import numpy as np

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, TorqueNotOff
from hil.drivers.torque.off import and_list
from hil.rest_pose_hint import within_limits
from hil.setup.session.servo_session import has_moved
from hil.setup.unmoved import wait_for_rest

AFTER_A_RUN = 2.0
"""Factor applied to arm.rest_tolerance after a run: friction may hold the arm farther from its rest pose than before.
"""

NEAR_RAD = 0.02
"""If no joint deviates from arm.rest_pose by more than this [rad], the motion starts and ends at arm.rest_pose."""

SAGGED_RAD, FROM_REST_RAD = 0.05, 0.1
"""After torque is cut, a joint's motion is reported if it exceeds the first value [rad]. No motion is reported if,
before that, any joint was farther than the second value [rad] from its rest angle.
"""

_LONGEST_SAG_S = 3.0  # longest wait for an arm that moves after torque is cut


def tolerance_now(config: Config) -> float:
    """Largest deviation from arm.rest_pose that is allowed before this run [rad]."""
    return config.rest_tolerance * (AFTER_A_RUN if has_moved() else 1.0)


def moved_without_torque(config: Config, bus: ServoBus, before: Sequence[float]) -> str:
    """Return a message about a spatial arm that has moved out of its rest pose since torque was cut.

    Returns "" if the arm has not moved, was not in its rest pose, or does not answer. before: pose when torque was cut
    (joints,) [rad]. Raises BusShared if another program switches torque on in the meantime.
    """
    at, rest = np.array(before), np.array(config.arm.rest_pose)
    if not config.is_chain or not np.abs(at - rest).max() < FROM_REST_RAD:
        return ""
    try:
        moving, after = wait_for_rest(bus, _LONGEST_SAG_S), np.array(bus.read_positions())
    except (BusShared, TorqueNotOff):
        raise
    except DriverError:
        return ""
    moved = [
        f"{joint.name!r} by {by:+.2f} rad"
        for joint, by in zip(config.joints, (after - at).tolist(), strict=True)
        if abs(by) > SAGGED_RAD
    ]
    if not moved:
        return ""
    pose = ", ".join(f"{each:.2f}" for each in after.tolist())
    now = moving or f"If it lies there safely, set arm.rest_pose = [{pose}]; otherwise choose another rest pose."
    return f"Once torque was off, the arm moved: {and_list(moved)}. It does not stay in its rest pose. {now}"


def from_where_it_lies(config: Config, position: Sequence[float]) -> Config:
    """Return the configuration with the measured pose (joints,) [rad], clipped to position_limit, as its rest pose.

    The configuration is returned unchanged if the two poses hardly differ, or if they differ so much that the run will
    be refused.
    """
    limits = [joint.position_limit for joint in config.joints]
    low, high = np.array(limits).T
    measured = np.array([within_limits(*each) for each in zip(position, limits, strict=True)])
    rest = np.array(config.arm.rest_pose)
    lies = np.clip(measured, low, high)
    if np.abs(measured - rest).max() > tolerance_now(config) or np.abs(lies - rest).max() <= NEAR_RAD:
        return config
    return config.model_copy(update={"arm": config.arm.model_copy(update={"rest_pose": lies.tolist()})})


def said_of_the_rest(config: Config, lies: Config) -> str:
    """Return a message that the arm does not lie in arm.rest_pose, with the actual angles of its joints."""
    each = zip(config.joints, lies.arm.rest_pose, config.arm.rest_pose, strict=True)
    away = [
        f"{joint.name!r} at {now:.3f} rad ({now - rest:+.3f})"
        for joint, now, rest in each
        if abs(now - rest) > NEAR_RAD
    ]
    return f"The arm does not lie in arm.rest_pose: {', '.join(away)}. The motion starts and ends where it lies."
