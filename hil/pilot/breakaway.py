"""Make joints that friction holds break away: torque rises from run to run, and a run ends soon after such a joint
moves.

Just above a joint's static friction, motion grows quickly: in many of the plausible arms, even a few percent more
torque makes a joint exceed a limit. The guard is therefore given narrow position limits for such joints, and the torque
is raised by a constant ratio from run to run, up to the current limit. As soon as the joint moves and so reveals its
friction, the arm is braked and the run ends.

If little room separates a joint's rest pose from a position limit, the largest torque that is safe for all plausible
arms may be too small to move the real one again. `FrictionWindow` keeps the search from repeating such a run.

A joint that gravity presses against an end stop also stands still until its torque lifts it. In the following runs, it
would bounce on this end stop, which the model of a planar arm does not include.
"""

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.estimation.unsettled.slips import unexplained
from hil.estimator.arrays import Array, Mask
from hil.estimator.baselines.torque_faults import suspect_stop
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError
from hil.pilot.belief import MOVED_STEPS
from hil.pilot.options import PilotOptions
from hil.pilot.seen import Seen
from hil.pilot.steps import Played

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
    past = ((seen[0] < near_low) & (near_low > low)) | ((seen[1] > near_high) & (near_high < high))
    return np.asarray(past & (seen[0] >= low) & (seen[1] <= high))


@dataclass(frozen=True)
class FrictionWindow:
    """Between which peak torques (joints,) [N m] a joint moves without exceeding its limits, as far as runs have shown.

    still: largest torque with which the joint stood still in a run that was stopped for this reason; 0 if none.
    enough: smallest larger torque with which it moved within its limits; infinite if none. exceeding: smallest torque
    with which it exceeded a limit; infinite if none.
    """

    still: Array
    enough: Array
    exceeding: Array

    @classmethod
    def unknown(cls, joints: int) -> "FrictionWindow":
        """The window before the first run."""
        return cls(np.zeros(joints), np.full(joints, np.inf), np.full(joints, np.inf))

    def after(self, config: Config, played: Played, swing: Array) -> "FrictionWindow":
        """The window after a run on an arm with the limits of `config`. swing: range of motion (joints,) [rad]."""
        torque = played.step.peak_torque
        step = np.array([joint.joint.servo.position_unit for joint in config.joints])
        stood = played.stood_still(swing / step)
        moved = ~stood & (swing > MOVED_STEPS * step)
        passed = _beyond_limits(config, played.step.seen) & played.passed_limit
        still = np.where(stood, np.maximum(self.still, torque), self.still)
        still = np.where(moved & (torque <= still), 0.0, still)
        exceeding = np.where(passed, np.minimum(self.exceeding, torque), self.exceeding)
        enough = np.where(moved & ~passed, np.minimum(self.enough, torque), self.enough)
        enough = np.where((enough <= still) | (enough >= exceeding), np.inf, enough)
        return FrictionWindow(still, enough, exceeding)

    def next(self, ratio: float, below: float, most: Array) -> Array:
        """The torque to try next with joints that stood still (joints,) [N m].

        ratio: relative to the torque with which the joint stood still. below: largest torque, relative to one that
        exceeded a limit. most: largest allowed torque (joints,) [N m].
        """
        untried = np.minimum(ratio * self.still, below * self.exceeding)
        return np.asarray(np.minimum(np.where(np.isfinite(self.enough), self.enough, untried), most))

    def message(self, config: Config, closed: Mask) -> str:
        """Say that no torque moves the `closed` joints (joints,) within their limits, and what to change."""
        said = " ".join(
            _closed(joint, rest, still, exceeding)
            for joint, rest, still, exceeding, is_closed in zip(
                *(config.joints, config.arm.rest_pose, self.still.tolist(), self.exceeding.tolist(), closed.tolist()),
                strict=True,
            )
            if is_closed
        )
        return (
            f"{said} More torque is not safe, and less does not overcome friction. If a hard stop, a table or a cable "
            "holds the arm near its rest pose, change the mounting so that it hangs freely, then correct arm.rest_pose "
            "and widen position_limit. If the joint turns freely by hand, raise the lower limit of experiment.band: "
            "at higher frequencies, more torque is safe."
        )


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


def _closed(joint: JointConfig, rest: float, still: float, exceeding: float) -> str:
    low, high = joint.position_limit
    room, end = min((rest - low, "lower"), (high - rest, "upper"))
    exceeded = f", but exceeded a limit with {exceeding:.3g} N m" if np.isfinite(exceeding) else ""
    return (
        f"{joint.joint.title} stood still with a peak torque of {still:.3g} N m{exceeded}. At rest, it is "
        f"{room:.2g} rad from the {end} end of its position_limit."
    )


def _beyond_limits(config: Config, seen: Array) -> Mask:
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    speed = np.array([joint.velocity_limit for joint in config.joints])
    return np.asarray((seen[0] < low) | (seen[1] > high) | (seen[2] > speed))
