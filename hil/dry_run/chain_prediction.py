"""Simulate a spatial arm's experiment on an ensemble of possible arms; compare the peaks with the limits, and find the
clearance.

Each arm follows every path in full: the transition from the rest pose, two periods, and the transition back.
"""

from dataclasses import dataclass

import numpy as np

from hil.clearance.space import Nearest, Space
from hil.config.schema import Config
from hil.dry_run.prediction import Prediction, limits_of, peaks_of
from hil.dry_run.resting_stops import planned_paths, resting_stops
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.simulation.rollout import ChainArms, Loop, Motions, roll_out
from hil.estimator.progress import Tell, counted
from hil.plan.chain_model import torque_limits
from hil.plan.chain_plan import PathSegment
from hil.plan.plan import Plan

PERIODS = 2
SHOWN = 30
LOOKED_AT_HZ = 100.0
"""Rate at which the clearance of a motion is computed [Hz]."""

RAN_AWAY = 1e3
"""Peak assigned to an arm whose simulation diverges, as a multiple of the limit."""


@dataclass(frozen=True)
class ChainPrediction:
    """Prediction of a spatial arm's experiment.

    peaks: predicted peaks and their limits. nearest: smallest clearance of any arm, which occurs `moment` [s] after the
    beginning of the segment `role`. rooms: smallest clearance of each arm minus the required one (arms,) [m]. tracking:
    median of the arms' largest tracking errors (joints,) [rad]. ways: number of samples of the transition at either end
    of the first segment.
    """

    peaks: Prediction
    nearest: Nearest
    role: str
    moment: float
    rooms: Array
    tracking: Array
    ways: int

    @property
    def is_clear(self) -> bool:
        """Whether every arm keeps the required clearance."""
        return bool((self.rooms >= 0.0).all())

    def __str__(self) -> str:
        if not self.nearest.is_limited:
            return str(self.nearest)
        where = f"{self.moment:.1f} s into {self.role!r}"
        return f"{self.nearest}, at least {1e3 * self.nearest.needed:.0f} mm required, {where}"


def predict_chain(
    config: Config,
    plan: Plan,
    arms: ChainArms,
    tell: Tell | None = None,
    shown: int = 0,
    passed: Mask | None = None,
) -> ChainPrediction:
    """Simulate `plan` on every arm. Raises ArmFileError, ConfigError.

    tell: called with the number of simulations done and the total. shown: number of motions to store. passed: whether
    each joint has ever been below its rest pose (row 0) and above it (row 1), as for `resting_stops`.
    """
    space = Space.of(config)
    limits, rest = limits_of(config), np.array(config.arm.rest_pose)
    stops = resting_stops(config, arms, planned_paths(plan), passed)
    values = np.zeros((arms.size, *limits.shape))
    rooms = np.full(arms.size, np.inf)
    worst: tuple[float, Nearest, str, float] | None = None
    seen: list[Array] = []
    tracking = np.zeros((arms.size, len(rest)))
    told = counted(tell, arms.size * len(plan.segments))
    for number, segment in enumerate(plan.segments):
        assert isinstance(segment, PathSegment)
        loop = loop_of(config, segment, plan.rate, stops)
        ways = segment.ramp_samples
        reference = np.concatenate(
            [segment.paths[0].position, *[segment.paths[1].position] * PERIODS, segment.paths[2].position], axis=1
        )
        for arm in range(arms.size):
            motions = roll_out(arms.chosen([arm]), loop, rest)
            peaks = _peaks(config, motions, limits)
            values[arm] = peaks if number == 0 else _extreme(values[arm], peaks)
            position = motions.position[0].T
            tracking[arm] = np.maximum(tracking[arm], np.nanmax(np.abs(position - reference), axis=1))
            nearest, moment = _nearest(space, position, ways, plan.rate)
            rooms[arm] = min(rooms[arm], nearest.room)
            if worst is None or nearest.room < worst[0]:
                worst = nearest.room, nearest, segment.role, moment
            if number == 0 and arm < shown:
                seen.append(position.copy())
            told()
    assert worst is not None
    together = np.stack(seen) if seen else np.empty((0, 0, 0))
    prediction = Prediction(
        values,
        _shares(values, limits, rest, _centre(plan)),
        limits,
        np.ones(arms.size, dtype=np.int64),
        together,
        rest,
        plan.rate,
        _centre(plan),
    )
    return ChainPrediction(prediction, *worst[1:], rooms, np.median(tracking, axis=0), plan.segments[0].ramp_samples)


def simulated_seconds(plan: Plan) -> float:
    """Duration of the motion that `predict_chain` simulates for one arm [s]."""
    samples = sum(2 * each.ramp_samples + PERIODS * len(each.period_current) for each in plan.segments)
    return samples / plan.rate


def loop_of(config: Config, segment: PathSegment, rate: float, stops: Array | None = None) -> Loop:
    """Commands and feedback of the control loop during a segment. stops: the end stop against which each joint rests,
    as in `Loop`.
    """
    assert config.stabiliser is not None  # checked with the configuration
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    goals = np.concatenate((segment.ramp_in, *[segment.period_current] * PERIODS, segment.ramp_out))
    return Loop(
        rate,
        goals * constants,
        np.array(config.stabiliser.stiffness),
        np.array(config.stabiliser.damping),
        np.array(config.arm.rest_pose),
        torque_limits(config),
        stops,
    )


def _peaks(config: Config, motions: Motions, limits: Array) -> Array:
    position, velocity, torque = (each[0].T for each in (motions.position, motions.velocity, motions.torque))
    if not np.isfinite(position[:, -1]).all():
        peaks = RAN_AWAY * np.abs(limits)
        peaks[0] = -peaks[0]
        return peaks
    constants = np.array([joint.torque_per_goal for joint in config.joints])[:, None]
    return peaks_of(config, position, velocity, torque / constants)


def _extreme(before: Array, now: Array) -> Array:
    most: Array = np.maximum(before, now)
    most[0] = np.minimum(before[0], now[0])
    return most


def _centre(plan: Plan) -> Array:
    segment = plan.segments[0]
    assert isinstance(segment, PathSegment)
    middle: Array = segment.paths[1].position.mean(axis=1)
    return middle


def _shares(values: Array, limits: Array, rest: Array, centre: Array) -> Array:
    """Peaks as fractions of the distance to their limits.

    Distances to position limits are measured from the rest pose or the path's centre, whichever is farther from the
    limit: an arm may rest close to a limit, which would make the fraction meaningless.
    """
    shares = np.zeros_like(values)
    shares[:, 2:] = np.abs(values[:, 2:] / limits[2:])
    low, high = np.minimum(rest, centre), np.maximum(rest, centre)
    shares[:, 0] = (high - values[:, 0]) / (high - limits[0])
    shares[:, 1] = (values[:, 1] - low) / (limits[1] - low)
    return shares


def _nearest(space: Space, position: Array, ways: int, rate: float) -> tuple[Nearest, float]:
    """Smallest clearance of a motion, and the time at which it occurs [s]. ways: number of samples of the transition at
    either end.
    """
    every = max(1, round(rate / LOOKED_AT_HZ))
    count = position.shape[1]
    parts = (slice(0, ways, every), slice(ways, count - ways, every), slice(count - ways, count, every))
    found: tuple[Nearest, float] | None = None
    for part, on_the_way in zip(parts, (True, False, True), strict=True):
        poses = np.nan_to_num(position[:, part])
        if on_the_way and poses.shape[1]:
            kept = ~space.lies(poses)
            moments = np.flatnonzero(kept)
            poses = poses[:, kept]
        else:
            moments = np.arange(poses.shape[1])
        if not poses.shape[1]:
            continue
        nearest = space.nearest(poses, on_the_way)
        moment = (part.start + every * int(moments[nearest.sample])) / rate
        if found is None or nearest.room < found[0].room:
            found = nearest, moment
    assert found is not None
    return found
