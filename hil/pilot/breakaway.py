"""Breakaway of joints held by friction: torque rises from run to run, and a run ends soon after a joint moves.

Just above a joint's static friction, motion grows quickly: on many of the plausible arms even a few percent more torque
makes a joint exceed a limit. Therefore the guard is given narrow limits for such joints, and the torque is raised by a
constant ratio from run to run, up to the current limit. As soon as the joint moves and so reveals its friction, the arm
is braked and the run ends.
"""

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.estimator.arrays import Array, Mask
from hil.pilot.options import PilotOptions


def raised(torque: Array, former: Array, still: Mask, ratio: float, most: Array) -> Array:
    """Return `torque` (joints,) [N m], but `ratio` times the `former` torque for joints that stood `still`.

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
