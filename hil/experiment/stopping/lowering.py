"""Stops an arm that cannot hang freely: brakes it, then lowers it to its rest pose for as long as its servos accept
commands.

The feed-forward torque is combined with the stabiliser's spring and damper, which track the path to the rest pose.
While a joint is off the path, an additional torque pulls it towards the path and grows with time. Lowering is monitored
like the experiment; torque is also cut if a motor turns against its goals (`hil.plan.obedience`). The damper acts only
on velocities that agree with the positions.

Replies may be missing for a moment, even at the beginning: joints that do not reply get only the feed-forward torque.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.errors import BusOverheard
from hil.drivers.servo_prior import servo_prior
from hil.drivers.state import State
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.estimator.arrays import Array
from hil.experiment.chain_watch import ChainWatch
from hil.experiment.guard import Guard
from hil.experiment.stopping.pace import LONGEST_S
from hil.plan.chain_model import torque_limits
from hil.plan.chain_plan import SETTLE_IN, PathSegment
from hil.plan.gains import most_damping, most_stiffness
from hil.plan.obedience import Obedience
from hil.plan.plan import Plan
from hil.plan.recent_motion import RecentMotion
from hil.plan.way_home import PULL_PER_S, PULL_SHARE, WayHome

LEAVES_RAD = 0.35
"""Largest accepted tracking error [rad]: if it is larger, the joint is not following its path to the rest pose."""

MOST_PATHS = 4
"""Maximum number of paths to the rest pose: if the arm is pushed off the last one, lowering is abandoned."""

LYING_RAD = 0.06
"""If every joint is within this angle of the rest pose [rad], the arm counts as resting in it."""

RUNS_AWAY = 0.25
"""Excess of a joint's velocity over the velocity of its path to the rest pose, relative to the velocity limit. A joint
that exceeds this and still speeds up although its torque opposes the motion counts as not obeying its motor.
"""

TOO_FAST = 0.6
"""Velocity, relative to the limit, above which torque is cut without a test if a joint seems not to obey its motor."""

_GROWS_S = 0.015
_ROOM_RAD = 0.2  # beyond the position limits and the path to the rest pose
_FASTER = 1.3


def may_lower(config: Config, error: BaseException) -> bool:
    """Whether, after this error, a spatial arm is to be lowered before torque is cut: configuration and cause must both
    allow it.
    """
    if config.safety.stop == "cut":
        return False
    if not isinstance(error, ExperimentError):
        return isinstance(error, BusOverheard)
    return error.cause.allows_lowering if isinstance(error, SafetyStop) else True


class Lowering:
    """Computes the goals on the path to the rest pose. Create it before torque is switched on; call `begin` when the
    stream is stopped.

    interval: time between two exchanges [s]; by default, the sample period.
    """

    def __init__(self, config: Config, plan: Plan, interval: float | None = None) -> None:
        segment = plan.segments[0]
        assert isinstance(segment, PathSegment)
        assert config.stabiliser is not None  # checked with the configuration
        self._config = config
        self._interval = interval
        self._way = WayHome(config, plan)
        self._thought = segment.thought
        self._planned = [float(peak) for peak in np.max([each.peak_goal for each in plan.segments], axis=0)]
        self._stiffness, self._damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
        self._constants = np.array([joint.torque_per_goal for joint in config.joints])
        self._rate = plan.rate
        self._gains = self._stiffness, self._damping
        self._growth = PULL_PER_S / plan.rate * self._stiffness
        priors = [(len(joint.ids), servo_prior(joint.joint.servo)) for joint in config.joints]
        self._lightest = np.array([servos * prior.armature.median for servos, prior in priors])
        usual = np.array([servos * prior.viscous.median for servos, prior in priors])
        self._friction = np.clip(self._thought.viscous, 0.0, usual)
        self._most_pull = PULL_SHARE * torque_limits(config)
        self._most_held = self._most_pull + np.array(self._planned) * self._constants
        self._fastest = RUNS_AWAY * np.array([joint.velocity_limit for joint in config.joints])
        self._fade = max(1, round(SETTLE_IN * plan.rate))
        self._rest = np.array(config.arm.rest_pose)
        self._thought.of(self._way.path(self._rest, np.zeros_like(self._rest)))  # compile in advance

    def slow_down(self, every: int) -> None:
        """From now on, compute goals only for every `every`-th sample, with a softer spring and damper."""
        rate = self._rate / every
        stiffness, damping = self._gains
        self._damping = np.minimum(damping, most_damping(rate, self._lightest))
        self._stiffness = np.minimum(stiffness, most_stiffness(rate, self._damping, self._friction))
        self._growth = PULL_PER_S / rate * self._stiffness

    def lies(self, state: State) -> bool:
        """Whether the arm is already at rest in its rest pose."""
        return bool(np.abs(self._away(state)).max() < LYING_RAD)

    def lies_elsewhere(self, state: State) -> str:
        """Name the joints that are not in the rest pose, with their positions."""
        each = zip(self._config.joints, state.position, self._away(state), strict=True)
        found = [
            f"{joint.name!r} is at {position:.3f} rad, {away:+.2f} rad from it"
            for joint, position, away in each
            if not abs(away) < LYING_RAD
        ]
        return ", ".join(found)

    def _away(self, state: State) -> Array:
        away: Array = np.array(state.position) - self._rest
        return away

    def begin(
        self,
        state: State,
        goal: list[float],
        recent: RecentMotion,
        watch: ChainWatch | None = None,
        noise: Sequence[float] | None = None,
    ) -> int:
        """Start lowering from this sample, the latest that all servos answered; return the number of samples that
        lowering takes.

        goal: latest goals [A or V]. recent: the latest exchanges. watch: the check against the model, which has seen
        the motion so far. noise: noise of each joint's current readings [A or V], if known.
        """
        self._recent, self._watch, self._noise = recent, watch, noise
        self._obedience = Obedience(len(state.position))
        self._paths = 0
        self.slow_down(1)
        velocity = self._believed(state)
        count = self._set_out(state, velocity, goal)
        if watch is not None:
            self._obedience.suspect(watch.residual, velocity.tolist(), state.time_before_write)
        return count

    def begin_again(self, state: State, goal: list[float]) -> int:
        """Plan another path to the rest pose from this sample; return its number of samples."""
        return self._set_out(state, self._believed(state), goal)

    def _believed(self, state: State) -> Array:
        return np.array(self._recent.until(state).believed(state))

    def _set_out(self, state: State, velocity: Array, goal: list[float]) -> int:
        """Plan a path to the rest pose from this sample; return its number of samples."""
        position = np.array(state.position)
        self._path = self._way.path(position, velocity)
        torque = self._thought.of(self._path)
        count = torque.shape[1]
        self._share = np.clip((count - np.arange(count)) / self._fade, 0.0, 1.0)
        self._feed = (self._share * torque).T
        self._pull = np.zeros_like(position)
        self._position, self._velocity = self._path.position.T.copy(), self._path.velocity.T.copy()
        self._guard = Guard(
            _widened(self._config, self._path.position, velocity),
            self._planned,
            interval=self._interval,
            patience=LONGEST_S,
            recent=self._recent,
            lowers_since=state.time_before_write,
            noise=self._noise,
        )
        self._guard.holding(goal)
        self._excess = deque[tuple[float, Array]]()
        self._against = np.zeros_like(position)
        self._paths += 1
        self.needs_another_path = False
        return int(count)

    def check_time(self, seconds: float) -> None:
        """Raise SafetyStop if lowering would take too long: `seconds` [s] in total."""
        longest = self._config.safety.lower_time
        if seconds > longest:
            raise SafetyStop(
                f"the arm was pushed off its path. With a new path, lowering would take {seconds:.1f} s in total; "
                f"safety.lower_time allows {longest:g} s.",
                Cause.UNEXPECTED,
            )

    def goals(self, index: int, state: State) -> list[float]:
        """Compute the goals [A or V] of one sample from the previous sample's state. Raises SafetyStop."""
        velocity = np.array(self._recent.believed(state))
        ahead = self._position[index] - np.array(state.position), self._velocity[index] - velocity
        missing = np.array(state.missing)
        held = np.where(missing, 0.0, self._stiffness * ahead[0] + self._damping * ahead[1])
        more = np.where(missing, 0.0, self._growth * ahead[0])
        self._pull = np.clip(self._pull + more, -self._most_pull, self._most_pull)
        self._against = np.clip(self._share[index] * self._pull + held, -self._most_held, self._most_held)
        torque = self._feed[index] + self._against
        for joint in range(len(torque)):
            if self._obedience.is_limp(joint):
                torque[joint] = 0.0
        return self._guard.clamp((torque / self._constants).tolist())

    def look(self, index: int, state: State, gap: float, *, between: bool = False) -> None:
        """Process an exchange. Raises SafetyStop if the arm leaves its path to the rest pose or a servo is faulty."""
        self._guard.look(state, gap, between=between)
        away = np.abs(self._position[index] - np.array(state.position))
        if np.nanmax(away, initial=0.0) > LEAVES_RAD:
            self._look_at_distance(int(np.nanargmax(away)), float(np.nanmax(away)))
        if not any(state.missing):
            self._look_at_obedience(index, state)

    def _look_at_distance(self, joint: int, away: float) -> None:
        """Check a joint that is `away` [rad] from its path; if it was pushed, request a new path."""
        pushed = self._obedience.is_pushed(joint)
        self.needs_another_path = pushed and self._paths < MOST_PATHS
        if not self.needs_another_path:
            why = ": something is pushing it, and its motor is too weak to resist." if pushed else "."
            title = self._config.joints[joint].joint.title
            raise SafetyStop(f"{title} is {away:.2f} rad off its lowering path{why}", Cause.UNEXPECTED)

    def _look_at_obedience(self, index: int, state: State) -> None:
        """Raise SafetyStop for a joint whose motor turns against its goals or whose torque fails to slow it down."""
        velocity, now = np.array(self._recent.believed(state)), state.time_before_write
        turned = -1
        if self._watch is not None:
            self._watch.observe(state)
            turned = self._obedience.look(self._watch.residual, velocity.tolist(), now)
        if turned >= 0:
            raise SafetyStop(
                f"{self._config.joints[turned].joint.title} is moving against its command: when the joint's goal was "
                "removed for a moment, the torque that the model could not explain vanished. Its motor turns the wrong "
                "way: check its direction and wiring, and whether another program has changed its Drive Mode.",
                Cause.WRONG_SIGN,
            )
        excess = velocity - self._velocity[index]
        while len(self._excess) > 1 and now - self._excess[1][0] >= _GROWS_S:
            self._excess.popleft()
        self._excess.append((now, excess))
        begun, before = self._excess[0]
        if now - begun < _GROWS_S:
            return
        runs = (np.abs(excess) > self._fastest) & (np.abs(excess) > np.abs(before)) & (self._against * excess < 0.0)
        if runs.any():
            self._look_at_runaway(int(np.argmax(runs)), velocity, now)

    def _look_at_runaway(self, joint: int, velocity: Array, now: float) -> None:
        """Test a joint that speeds up although its torque opposes the motion. Raises SafetyStop if there is no model,
        or if the joint is so fast that its motor no longer matters.
        """
        share = abs(velocity[joint]) / self._config.joints[joint].velocity_limit
        if self._watch is not None and share < TOO_FAST and self._obedience.question(joint, now):
            return
        raise SafetyStop(
            f"{self._config.joints[joint].joint.title} is speeding up (now {velocity[joint]:+.2f} rad/s) "
            "although its torque opposes the motion: its motor turns the wrong way or has failed, something is pushing "
            "the joint, or the arm is not the one described.",
            Cause.WRONG_SIGN,
        )

    def others_answer(self) -> None:
        """Record that some servos seem silent only because a silent servo hides their replies."""
        self._guard.others_answer()

    def late(self, seconds: float) -> None:
        """Record a missed deadline, `seconds` after the last command. Raises SafetyStop if the gap is too long."""
        self._guard.late(seconds)


def _widened(config: Config, position: np.ndarray, velocity: np.ndarray) -> Config:
    """Return the configuration with limits widened for lowering, given the arm's position and velocity when stopped."""
    fastest = max(_FASTER * float(np.abs(velocity).max()), 2.0 * config.safety.lower_speed) + 0.5
    joints = [
        _allowing(joint, float(row.min()), float(row.max()), max(fastest, joint.velocity_limit))
        for joint, row in zip(config.joints, position, strict=True)
    ]
    # An arm on which a servo has only lost its watchdog can still be lowered, which is better than dropping it.
    unwatched = config.safety.model_copy(update={"allow_no_watchdog": True})
    return config.model_copy(update={"joints": joints, "safety": unwatched})


def _allowing(joint: JointConfig, low: float, high: float, velocity: float) -> JointConfig:
    limits = [min(joint.position_limit[0], low) - _ROOM_RAD, max(joint.position_limit[1], high) + _ROOM_RAD]
    return joint.model_copy(update={"position_limit": limits, "velocity_limit": velocity})
