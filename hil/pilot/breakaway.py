"""Make joints that friction holds break away: torque rises from run to run, and a run ends soon after such a joint
moves.

Just above a joint's static friction, motion grows quickly: in many of the plausible arms, even a few percent more
torque makes a joint exceed a limit. The guard is therefore given narrow position limits for such joints, and the torque
is raised by a constant ratio from run to run, up to the current limit. As soon as the joint moves and so reveals its
friction, the arm is braked and the run ends.

A joint that gravity presses against an end stop also stands still until its torque lifts it. In the following runs, it
would bounce on this end stop, which the model of a planar arm does not include.
"""

import math
from contextlib import suppress

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.estimation.unsettled.slips import unexplained
from hil.estimator.arrays import Array, Mask
from hil.estimator.baselines.torque_faults import suspect_stop
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError
from hil.pilot.options import PilotOptions
from hil.pilot.seen import Seen

_LEANS = 0.1
"""Gravity may press a link against something if the absolute cosine of the link's angle at rest is at least this."""

_AT_REST_RAD = 0.03
"""Largest distance between the joint's angle before the run and an end stop that it rests against [rad]."""

_UNEXPLAINED = 0.25
"""An end stop is suspected only if inverse dynamics without one leaves at least this fraction of the torque
unexplained.
"""


def raised(torque: Array, former: Array, still: Mask, ratio: float, most: Array) -> Array:
    """Return the next torques (joints,) [N m]: `torque`, except that joints that stood `still` get `ratio` times the
    `former` one.

    most: upper limit for those joints, set by the current limits (joints,) [N m].
    """
    return np.asarray(np.where(still, np.minimum(ratio * former, most), torque))


def narrowed(config: Config, pose: Array, still: Mask, options: PilotOptions) -> Config:
    """Return the configuration with position limits close to `pose` (joints,) [rad] for joints that stood `still`."""
    joints = [
        joint.model_copy(update={"position_limit": _near(joint, at, options)}) if held else joint
        for joint, at, held in zip(config.joints, pose.tolist(), still.tolist(), strict=True)
    ]
    return config.model_copy(update={"joints": joints})


def _near(joint: JointConfig, pose: float, options: PilotOptions) -> tuple[float, float]:
    low, high = joint.position_limit
    least = options.min_breakaway_steps * joint.joint.servo.position_unit
    below, above = (max(options.breakaway_room * abs(end - pose), least) for end in (low, high))
    return max(low, pose - below), min(high, pose + above)


def broke_free(config: Config, narrow: Config, seen: Array) -> Mask:
    """Return which joints (joints,) exceeded a limit of `narrow` but none of the wider limits of `config`.

    seen: lowest and highest position and largest speed of each joint (3, joints) [rad, rad/s].
    """
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    near_low, near_high = np.array([joint.position_limit for joint in narrow.joints]).T
    closer = (near_low > low) | (near_high < high)
    return np.asarray(closer & ((seen[0] < near_low) | (seen[1] > near_high)))


def resting_on_stop(config: Config, seen: Seen) -> str:
    """Return a message if a joint of a planar arm rests against something, so that it can move in one direction only;
    otherwise "".
    """
    leans = any(abs(math.cos(angle)) > _LEANS for angle in np.cumsum(config.arm.rest_pose))
    if config.arm.gravity == 0.0 or not leans:
        return ""
    steps = np.array([joint.joint.servo.position_unit for joint in config.joints])
    time = np.arange(seen.torque.shape[1]) / config.experiment.rate
    stop = None
    with suppress(RecordingError):  # a joint that hardly moved
        stop = suspect_stop([Recording(time, seen.torque, seen.position, steps, "held")])
    if stop is None or stop.residual_given < _UNEXPLAINED or abs(stop.at - seen.pose[stop.joint - 1]) > _AT_REST_RAD:
        return ""
    return (
        f"{config.joints[stop.joint - 1].joint.title} rests against something compliant (an end stop, a table or a "
        f"cable) at {stop.at:.2f} rad: with a stiffness of {float(f'{stop.stiffness:.2g}'):g} N m/rad there, "
        f"{unexplained(stop.residual, stop.residual_given)}. "
        "In every further run, the arm would press and bounce against it, and the model of a planar arm includes no "
        "end stops. Change the mounting, or what the arm rests on, so that the arm hangs freely, then correct "
        "arm.rest_pose; or describe the arm with a URDF, in which case joints may rest against end stops."
    )
