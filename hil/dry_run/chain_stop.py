"""Simulation of stopping a spatial arm: it is lowered if its servos still accept commands, and falls if they do not.

Stops begin at times spread over the planned path. For each of them, the path to the rest pose and the unpowered fall up
to the first collision are simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.clearance.space import LYING_RAD, Nearest, Space
from hil.config.schema import Config
from hil.dry_run.resting_stops import planned_paths, resting_stops
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.simulation.rollout import COULOMB, SCALE, ChainArms, Loop, Pull, roll_out, weights
from hil.estimator.progress import Tell, counted
from hil.plan.chain_model import torque_limits
from hil.plan.chain_plan import PathSegment
from hil.plan.plan import Plan
from hil.plan.way_home import PULL_PER_S, PULL_SHARE, WayHome

MOMENTS, ARMS = 16, 6
FALL_S = 1.5
SATURATED = 0.98
LAID_DOWN = 0.95
"""Fraction of the simulated stops that must end in the rest pose."""


@dataclass(frozen=True)
class Fall:
    """The worst of the simulated falls.

    moment: time along the path at which it starts [s]. hits: names of the colliding parts; None if nothing collides
    within FALL_S. seconds: duration [s]. height: largest descent [m]. speed: largest speed at the end of the fall
    [m/s]. beyond: largest distance by which each joint exceeds its limits in any fall (joints,) [rad].
    """

    moment: float
    hits: tuple[str, str] | None
    seconds: float
    height: float
    speed: float
    beyond: Array


@dataclass(frozen=True)
class LoweringForeseen:
    """Prediction of how a stopped arm is lowered: the worst of the simulated stops.

    seconds: longest duration [s]. nearest: smallest clearance. lies: fraction of simulations that end in the rest pose.
    joint: name of the joint that ends farthest from its rest angle, by `away` [rad]. helps: suggested remedy.
    """

    seconds: float
    nearest: Nearest
    lies: float
    joint: str
    away: float
    helps: str


@dataclass(frozen=True)
class ChainStops:
    """The worst fall and the worst lowering of the arm among the simulated stops of a plan."""

    fall: Fall
    lowering: LoweringForeseen

    @property
    def unsafe(self) -> str:
        """Explain why the arm would not be lowered safely when stopped; "" if it would be."""
        down = self.lowering
        if down.nearest.room < 0.0:
            return (
                f"too little clearance when a stopped arm is lowered ({down.nearest}; at least "
                f"{1e3 * down.nearest.needed:.0f} mm required). Lower safety.lower_speed, choose a rest_pose farther "
                "from obstacles, or specify the masses more accurately"
            )
        if down.lies < LAID_DOWN:
            return (
                f"only {100 * down.lies:.0f} % of the simulated stops bring the arm to the rest pose, but at least "
                f"{100 * LAID_DOWN:.0f} % must: {down.joint!r} ends up to {down.away:.2g} rad away from it. "
                f"{down.helps}"
            )
        return ""


def foreseen_stops(
    config: Config,
    plan: Plan,
    arms: ChainArms,
    tell: Tell | None = None,
    passed: Mask | None = None,
) -> ChainStops:
    """Simulate stops at times spread over the first path. Raises ConfigError, ArmFileError.

    tell: called with the number of simulations done and the total. passed: whether each joint has ever been below its
    rest pose (row 0) and above it (row 1), as for `resting_stops`.
    """
    segment = plan.segments[0]
    assert isinstance(segment, PathSegment)
    few = arms.first(ARMS)
    path = segment.paths[1]
    count = path.position.shape[1]
    moments = np.linspace(0, count, MOMENTS, endpoint=False).astype(int)
    starts = [(each / plan.rate, path.position[:, each], path.velocity[:, each]) for each in moments]
    told = counted(tell, 2 * len(starts) * few.size)
    return ChainStops(
        _hardest(config, plan.rate, few, starts, told),
        _lowered(config, plan, few, starts, told, resting_stops(config, few, planned_paths(plan), passed)),
    )


def _hardest(
    config: Config, rate: float, arms: ChainArms, starts: list[tuple[float, Array, Array]], told: Callable[[], None]
) -> Fall:
    space = Space.of(config)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    n = len(low)
    nothing = np.zeros(n)
    loop = Loop(rate, np.zeros((round(FALL_S * rate), n)), nothing, nothing, np.array(config.arm.rest_pose), nothing)
    worst: Fall | None = None
    beyond = np.zeros(n)
    for moment, position, velocity in starts:
        motions = roll_out(arms, loop, position, velocity)
        for arm in range(arms.size):
            q = motions.position[arm].T
            q = q[:, np.isfinite(q).all(axis=0)]
            room = space.room(q, on_the_way=True)
            hit = np.flatnonzero(room < 0.0)
            end = int(hit[0]) if hit.size else q.shape[1] - 1
            until = q[:, : end + 1]
            beyond = np.maximum(beyond, np.maximum(low - until.min(axis=1), until.max(axis=1) - high))
            pair = space.nearest(q[:, end : end + 1], on_the_way=True).pair if hit.size else None
            height, speed = _dropped(space, q[:, 0], q[:, max(end - 1, 0)], q[:, end], rate)
            if worst is None or (hit.size > 0, speed) > (worst.hits is not None, worst.speed):
                worst = Fall(moment, pair, end / rate, height, speed, beyond)
            told()
    assert worst is not None
    return Fall(worst.moment, worst.hits, worst.seconds, worst.height, worst.speed, np.maximum(beyond, 0.0))


def _dropped(space: Space, first: Array, before: Array, last: Array, rate: float) -> tuple[float, float]:
    """Largest descent of any point of the arm [m], and the speed of its fastest point [m/s]."""
    up, _ = space.floor
    top, former, bottom = (space.ends(pose)[0] for pose in (first, before, last))
    if not top.size:
        return 0.0, 0.0
    return float(((top - bottom) @ up).max()), float(np.linalg.norm(bottom - former, axis=-1).max() * rate)


def _helps(config: Config, at: int, longest: float, used: float, needed: float) -> str:
    """Suggest a remedy for a joint that is not lowered to its rest angle when the experiment is stopped.

    longest: duration of the longest path [s]. used: largest torque, relative to the limit. needed: largest torque that
    the simulated arms need to move slowly [N m].
    """
    joint = config.joints[at]
    slower = "raise safety.lower_time" if longest >= config.safety.lower_time else "lower safety.lower_speed"
    if needed > joint.goal_limit * joint.torque_per_goal:
        wanted = f"{1.1 * needed / joint.torque_per_goal:.2g} {joint.drive_mode.goal_unit}"
        first = f"Raise its {joint.goal_limit_name} to {wanted} if the servo tolerates that, "
    elif used > SATURATED:
        first = f"Raise its {joint.goal_limit_name}, {slower}, "
    else:  # friction or wrong masses, against a stabiliser that is soft because the rate is low
        first = f"Raise experiment.rate above {config.experiment.rate:g}, which makes its stabiliser stiffer, "
    return f"{first}choose a rest_pose in which gravity loads it less, or specify the masses more accurately"


def _lowered(
    config: Config,
    plan: Plan,
    arms: ChainArms,
    starts: list[tuple[float, Array, Array]],
    told: Callable[[], None],
    stops: Array,
) -> LoweringForeseen:
    segment = plan.segments[0]
    assert isinstance(segment, PathSegment)
    assert config.stabiliser is not None  # checked with the configuration
    way, space, rest = WayHome(config, plan), Space.of(config), np.array(config.arm.rest_pose)
    stiffness, damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
    longest, lies, worst = 0.0, [], None
    away, used, needed = (np.zeros(len(rest)) for _ in range(3))
    for _, position, velocity in starts:
        home = way.path(position, velocity)
        goal = segment.thought.of(home).T + stiffness * (home.position.T - rest) + damping * home.velocity.T
        pull = Pull(home.position.T, PULL_PER_S, PULL_SHARE)
        loop = Loop(plan.rate, goal, stiffness, damping, rest, torque_limits(config), stops, pull)
        motions = roll_out(arms, loop, position, velocity)
        longest = max(longest, len(goal) / plan.rate)
        used = np.maximum(used, np.nanmax(np.abs(motions.torque), axis=(0, 1)) / torque_limits(config))
        needed = np.maximum(needed, _needed(arms, position))
        for arm in range(arms.size):
            q = np.nan_to_num(motions.position[arm].T, nan=1e3)
            off = np.abs(q[:, -1] - rest)
            lies.append(bool(off.max() < LYING_RAD))
            away = np.maximum(away, off)
            kept = ~space.lies(q)
            if kept.any():
                nearest = space.nearest(q[:, kept], on_the_way=True)
                worst = nearest if worst is None or nearest.room < worst.room else worst
            told()
    nothing = Nearest(np.inf, 0.0, ("nothing", "nothing"), 0)
    farthest = int(np.argmax(away))
    return LoweringForeseen(
        longest,
        nothing if worst is None else worst,
        float(np.mean(lies)),
        config.joints[farthest].name,
        float(min(away[farthest], np.pi)),
        _helps(config, farthest, longest, float(used[farthest]), float(needed[farthest])),
    )


def _needed(arms: ChainArms, pose: Array) -> Array:
    """Torque needed to move each joint slowly in this pose, for the arm that needs the most (joints,) [N m]."""
    each = (np.abs(weights(arms, pose)) + arms.drive[:, COULOMB]) / arms.drive[:, SCALE]
    most: Array = each.max(axis=0)
    return most
