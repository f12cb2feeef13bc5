"""Check during the experiment that a spatial arm's motion is consistent with some arm of the dry run's ensemble.

The prior knowledge is the ensemble's mean and inflated covariance. While the whole arm is in its rest pose, something
may support it, so no joint is judged. A joint that stands still at its rest angle may be lying against an end stop. It
is therefore judged only while torque pushes it back towards the side from which it came. The same applies to a joint
that has just returned to its rest angle, since it may have hit the end stop. If a joint has not yet left its rest
angle, the end stop may be on the side towards which gravity pulls the joint. The joint may then fail to move towards
that side, unless the commanded torque pushes it there as well.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from hil.config.schema import Config
from hil.drivers.state import State
from hil.dry_run.chain_prior import prior_arms
from hil.errors import Cause, SafetyStop
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.simulation.motion_observer import ChainObserver
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.experiment.checks.apart import causes_of_standstill
from hil.experiment.checks.consistency import check_standstill
from hil.experiment.model_watch import UNLIKE_ANY_ARM, Explain
from hil.plan.chain_model import known_chain
from hil.plan.obedience import Residual

ARMS = 96
WIDENED = 1.5
"""Factor by which the ensemble's standard deviations are enlarged, to allow for effects that its model does not
include.
"""

LYING_RAD = 0.08
_FRICTIONS = 8.0
"""Lower bound on the torque from which alarm thresholds are derived, in multiples of the mean dry friction. It keeps
friction of up to twice the mean from raising an alarm.
"""
_RELATIVE_STD = 0.05
_STILL_RAD_S = 0.06
_IMPACT_S, _MOST_REBOUND = 0.05, 0.5
"""How long a joint that has returned to its rest angle may bounce off an end stop [s], and its largest speed while
bouncing, as a fraction of its speed before the impact.
"""
WINDOW_S = 0.3
"""Time span [s] for which a message about a stationary joint gives the range of torques."""

_DOUBTS = (
    "The arm may not be the one described: the direction, zero_ticks or axis of this joint or of another one, or "
    "arm.base, may be wrong. Move the joints by hand, with torque off, to find out."
)
_AGAINST_STOP = " With a wrong direction, its motor may press the joint against the end stop on which it rests."


class ChainWatch:
    """Checks every sample against the model.

    planned: largest goal of each joint [A, or V in PWM mode]. arms: prior knowledge of the arm; by default, from the
    configuration. interval, explain: as for `ModelWatch`. has_moved: whether the arm has moved as described in an
    earlier run, so that a message names the description last.
    """

    def __init__(
        self,
        config: Config,
        planned: Sequence[float],
        arms: ChainArms | None = None,
        interval: float | None = None,
        explain: Explain = lambda *_: None,
        *,
        has_moved: bool = False,
    ) -> None:
        self._explain = explain
        self._has_moved = has_moved
        arms = prior_arms(config, known_chain(config), ARMS) if arms is None else arms
        self._constants = np.array([joint.torque_per_goal for joint in config.joints])
        mean, covariance = observed_parameters(arms)
        n = len(self._constants)
        largest = self._constants * np.array(planned)
        interval = 1.0 / config.experiment.rate if interval is None else interval
        # A light joint's torque barely exceeds dry friction, whose behaviour near standstill is not modelled.
        self._observer = ChainObserver(arms.base, mean, covariance, largest, interval, _FRICTIONS)
        self._names = [joint.joint.title for joint in config.joints]
        self._blocked_by = [causes_of_standstill(joint.joint) for joint in config.joints]
        self._rest = np.array(config.arm.rest_pose)
        count = arms.base.count
        gravity = arms.base.regressor(self._rest[:, None], *np.zeros((2, n, 1)))[:, 0] @ mean[:count]
        self._friction = mean[count + n : count + 2 * n]
        self._falls_to = np.where(np.abs(gravity) > self._friction, -np.sign(gravity), 0.0)
        self._was_below, self._was_above = np.zeros((2, n), dtype=np.bool_)
        self._commanded: deque[tuple[State, Array]] = deque(maxlen=math.ceil(WINDOW_S / interval))
        self._goal: Sequence[float] | None = None
        self._seen_at = 0.0
        self._velocity = np.zeros(n)
        """Latest velocities (joints,) [rad/s]."""
        self._hit_at, self._hit_speed = np.full(n, -np.inf), np.zeros(n)
        """When each joint last appeared to hit an end stop near its rest angle [s], and its speed before that impact
        [rad/s].
        """

    def look(self, state: State) -> None:
        """Process the latest sample. Raises SafetyStop if no arm of the ensemble could have moved like this."""
        joint = self.observe(state)
        if joint >= 0:
            self._raise(joint, state)

    @property
    def residual(self) -> Residual:
        """How far the model explains the torque in the latest sample."""
        return Residual(self._observer.lacking, self._observer.torque, self._observer.is_beyond)

    def observe(self, state: State) -> int:
        """Process a sample without raising an exception; return the joint whose motion is inconsistent, or -1."""
        if any(state.missing):
            return -1
        goal, self._goal = self._goal, state.goal_current
        seconds, self._seen_at = state.time_before_write - self._seen_at, state.time_before_write
        if goal is None:
            goal, seconds = state.goal_current, float("inf")
        position = np.array(state.position)
        away, velocity = position - self._rest, np.array(state.velocity)
        is_away = np.abs(away) > LYING_RAD
        is_free = bool(is_away.any())
        if is_free:
            self._was_above |= away > LYING_RAD
            self._was_below |= away < -LYING_RAD
        torque = self._constants * goal
        support = self._support(is_away, velocity, torque) if is_free and not is_away.all() else None
        self._commanded.append((state, torque))
        return self._observer.observe(position, velocity, torque, seconds, is_free, support)

    def _support(self, is_away: Mask, velocity: Array, torque: Array) -> Array:
        """Direction in which an end stop may block each joint (joints,): 1, -1, or 0 if none can.

        is_away: whether each joint is away from its rest angle. torque: commanded torque (joints,) [N m].
        """
        may_lie = ~self._was_below & ~self._was_above & (torque * self._falls_to <= self._friction)
        towards = np.where(may_lie, self._falls_to, self._was_below * 1.0 - self._was_above * 1.0)
        approach, before = velocity * towards, self._velocity * towards
        hits = ~is_away & (before > _STILL_RAD_S) & (approach < before)  # an end stop can only slow a joint down
        is_recent = self._seen_at - self._hit_at <= _IMPACT_S
        self._hit_speed = np.where(hits, np.maximum(before, is_recent * self._hit_speed), self._hit_speed)
        self._hit_at = np.where(hits, self._seen_at, self._hit_at)
        bounces = (hits | is_recent) & (-approach <= _MOST_REBOUND * self._hit_speed)
        self._velocity = velocity
        is_home = ~is_away & ((np.abs(velocity) <= _STILL_RAD_S) | bounces)
        return np.asarray(is_home * towards)

    def _raise(self, joint: int, state: State) -> None:
        lacking = self._observer.lacking[joint]
        name = self._names[joint]
        check_standstill(name, (state for state, _ in reversed(self._commanded)), joint, _STILL_RAD_S)
        if abs(state.velocity[joint]) < _STILL_RAD_S:
            since = self._seen_at - WINDOW_S
            recent = [torque[joint] for at, torque in self._commanded if at.time_before_write >= since]
            said = (
                f"{name} is not moving, with {min(recent):+.3f} to {max(recent):+.3f} N m commanded in the last "
                f"{WINDOW_S:g} s: any arm consistent with the prior and the data so far would be moving."
            )
            blocked_by = self._blocked_by[joint]
            against_stop = "" if self._was_below[joint] or self._was_above[joint] else _AGAINST_STOP
            causes = self._ordered(f"{_DOUBTS}{against_stop}", blocked_by)
        else:
            self._explain(joint, float(lacking), [state for state, _ in self._commanded])
            said = (
                f"{name} {UNLIKE_ANY_ARM} consistent with the prior and the data so far: "
                f"{lacking:+.3f} N m of the commanded torque is not reflected in its motion."
            )
            failed = "Its motor or its encoder has failed, its horn slips, or something is pushing or holding it."
            causes = self._ordered(_DOUBTS, failed)
        raise SafetyStop(said, Cause.UNEXPECTED, causes)

    def _ordered(self, doubts: str, failed: str) -> str:
        """Combine doubts about the description with causes in the arm itself, the likelier ones first."""
        first, link, second = doubts, "Otherwise, ", failed
        if self._has_moved:
            first, link, second = failed, "If none of this applies: ", doubts
        return f"{first} {link}{second[0].lower()}{second[1:]}"


def observed_parameters(arms: ChainArms) -> tuple[Array, Array]:
    """Mean and inflated covariance of an ensemble's `linear_parameters`, in units of the commanded torque."""
    drawn = linear_parameters(arms)
    mean = drawn.mean(axis=0)
    covariance = WIDENED**2 * np.cov(drawn.T) + np.diag((_RELATIVE_STD * mean) ** 2 + 1e-12)
    n = arms.drive.shape[2]
    offset = slice(len(mean) - n, len(mean))
    at = np.arange(len(mean))[offset]
    covariance[at, at] += (0.5 * mean[len(mean) - 2 * n : len(mean) - n]) ** 2
    return mean, np.asarray(covariance)


def linear_parameters(arms: ChainArms) -> Array:
    """Base parameters, viscous and dry friction, and offsets of each arm (arms, base + 3 * joints).

    They are in SI units, divided by the joint's ratio of actual to commanded torque, so that they refer to the
    commanded torque. If the ratios of the joints differ, a base parameter that affects several joints is divided by the
    first joint's ratio.
    """
    scale = arms.drive[:, 4]
    owner = np.array([int(name.rpartition("_")[2]) - 1 for name in arms.base.names])
    drive = arms.drive[:, :3] / scale[:, None, :]
    return np.concatenate((arms.rigid / scale[:, owner], drive.reshape(arms.size, -1)), axis=1)
