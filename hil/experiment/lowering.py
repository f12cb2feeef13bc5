"""A stop of an arm that cannot hang: brake, then lower it to its rest pose, while its servos still take commands.

Feed-forward of what is thought of the arm, with the stabiliser's spring and damper around the way home. It is watched
like the experiment: a reply missing, an alert, a current that does not follow or a joint that leaves the way end it,
and torque is cut.
"""

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.state import State
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.experiment.guard import Guard
from hil.plan.chain_plan import SETTLE_IN, PathSegment
from hil.plan.plan import Plan
from hil.plan.way_home import WayHome

LEAVES_RAD = 0.35
"""Off its way: a joint that is farther away does not follow it."""

LYING_RAD = 0.06
"""From the rest pose: an arm that is nearer lies already."""

_ROOM_RAD = 0.2  # beyond position limits and the pose in which it was stopped
_FASTER = 1.3


def may_lower(config: Config, error: BaseException) -> bool:
    """Whether this stop lowers the arm before torque is cut: configuration and cause must both allow it."""
    if not config.is_chain or config.safety.stop == "cut" or not isinstance(error, ExperimentError):
        return False
    return error.cause.allows_lowering if isinstance(error, SafetyStop) else True


class Lowering:
    """Goals on the way home. Made before torque is on; `begin` when a stop comes."""

    def __init__(self, config: Config, plan: Plan) -> None:
        segment = plan.segments[0]
        assert isinstance(segment, PathSegment)
        assert config.stabiliser is not None  # checked with the configuration
        self._config = config
        self._way = WayHome(config, plan)
        self._thought = segment.thought
        self._stiffness, self._damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
        self._constants = np.array([joint.torque_per_goal for joint in config.joints])
        self._fade = max(1, round(SETTLE_IN * plan.rate))
        self._rest = np.array(config.arm.rest_pose)
        self._thought.of(self._way.path(self._rest, np.zeros_like(self._rest)))  # compiled

    def lies(self, state: State) -> bool:
        """Whether the arm already lies in its rest pose."""
        away = np.abs(np.array(state.position) - self._rest)
        return bool(away.max() < LYING_RAD)

    def begin(self, state: State, goal: list[float]) -> int:
        """From this sample, the last goals being `goal` [A or V]. Returns how many samples it takes."""
        position, velocity = np.array(state.position), np.array(state.velocity)
        self._path = self._way.path(position, velocity)
        torque = self._thought.of(self._path)
        count = torque.shape[1]
        share = np.clip((count - np.arange(count)) / self._fade, 0.0, 1.0)
        self._feed = (share * torque).T
        self._position, self._velocity = self._path.position.T.copy(), self._path.velocity.T.copy()
        self._guard = _guard_of(self._config, self._path.position, velocity)
        self._guard.holding(goal)
        return int(count)

    def goals(self, index: int, state: State) -> list[float]:
        """Goals [A or V] of one sample, from the state before; raises SafetyStop."""
        ahead = self._position[index] - np.array(state.position), self._velocity[index] - np.array(state.velocity)
        held = np.where(np.array(state.missing), 0.0, self._stiffness * ahead[0] + self._damping * ahead[1])
        return self._guard.clamp(((self._feed[index] + held) / self._constants).tolist())

    def look(self, index: int, state: State, gap: float) -> None:
        """Raise SafetyStop where the arm does not follow its way, or anything is wrong with a servo."""
        self._guard.look(state, gap)
        away = np.abs(self._position[index] - np.array(state.position))
        if np.nanmax(away, initial=0.0) > LEAVES_RAD:
            joint = self._config.joints[int(np.nanargmax(away))].joint
            raise SafetyStop(f"{joint.title} is {np.nanmax(away):.2f} rad off its way down.", Cause.UNEXPECTED)

    def late(self, seconds: float) -> None:
        """A deadline passed; raises SafetyStop after too long a time."""
        self._guard.late(seconds)


def _guard_of(config: Config, position: np.ndarray, velocity: np.ndarray) -> Guard:
    """A guard that allows for where and how fast the arm was when it was stopped, and for no more than that."""
    fastest = max(_FASTER * float(np.abs(velocity).max()), 2.0 * config.safety.lower_speed) + 0.5
    joints = [
        _allowing(joint, float(row.min()), float(row.max()), max(fastest, joint.velocity_limit))
        for joint, row in zip(config.joints, position, strict=True)
    ]
    return Guard(config.model_copy(update={"joints": joints}))


def _allowing(joint: JointConfig, low: float, high: float, velocity: float) -> JointConfig:
    limits = [min(joint.position_limit[0], low) - _ROOM_RAD, max(joint.position_limit[1], high) + _ROOM_RAD]
    return joint.model_copy(update={"position_limit": limits, "velocity_limit": velocity})
