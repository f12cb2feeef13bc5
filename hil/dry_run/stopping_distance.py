"""How far an arm overshoots its position limits when it is stopped, for each kind of stop.

The stop itself is simulated on the arms of an ensemble, with gravity, friction and coupling between the joints:

planned   the run is stopped at any moment of the planned motion, because of a signal, lost replies, an alert, a lost
          port, or a killed program
passed    the motion differs from the plan (a blocked, reversed or unpowered joint, or an arm other than the one
          described), so the guard stops it at a limit: one joint at its position limit moves outwards at its velocity
          limit; the other is anywhere within its range
"""

import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from itertools import product

import numpy as np

from hil.config.schema import Config
from hil.dry_run.bounded_energy import Boundary, boundary
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.prediction import scaled_feedback
from hil.estimator.arrays import Array
from hil.estimator.models.parameters import CONSTANTS, Physics
from hil.estimator.simulation.closed_loop import Feedback, Response, Simulator, respond, resting
from hil.estimator.simulation.many_arms import COARSE
from hil.estimator.threads import thread_count
from hil.plan.brake import GETS_FASTER, NOTICED_AFTER, braking_gains
from hil.plan.plan import Plan
from hil.plan.silence import missing_limit
from hil.plan.stabiliser import feedback_of

LONGEST_S = 1.5
"""Time for which a stopped arm is simulated [s]: long enough for a swing and its return."""

_ARMS = 16
_THREADS = 2
_AHEAD_S = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.2)
"""To find the moments that lead to the largest overshoot, the position is extrapolated at constant velocity over these
times [s].
"""
_EVENLY = 16
_IMMOVABLE = 1e3  # kg m^2
_JUDGED_AFTER_S = (0.05, 0.2, 0.5)
"""Times after torque is cut [s] at which a simulation ends if the arm no longer has enough energy to exceed its
limits.
"""
_REACTION = 2
"""Number of samples until the stop takes effect: the sample that shows the fault, and the one in progress."""


class Way(StrEnum):
    """How the arm is stopped.

    CUT: torque off. BRAKED: braked, then torque off. REVERSED: braking accelerates the joint because a sign is
    reversed, so braking ends and torque is cut. SILENT: some or all servos receive nothing until their watchdogs trip.
    SILENT_BRAKE: the same, from the moment at which braking begins.
    """

    CUT = "cut"
    BRAKED = "braked"
    REVERSED = "reversed"
    SILENT = "silent"
    SILENT_BRAKE = "silent brake"


@dataclass(frozen=True)
class Stopping:
    """Largest overshoot beyond a position limit, by kind of stop (joints,) [rad], over all arms and initial states."""

    planned: dict[Way, Array]
    passed: dict[Way, Array]


@dataclass(frozen=True)
class _Start:
    """State in which stopping begins.

    state: as expected by `respond` (5 or 6, joints). goal: torque commanded by the previous goals (joints,) [N m].
    jammed: index of a blocked joint, or None.
    """

    state: Array
    goal: Array
    jammed: int | None = None


_Piece = tuple[Array, Feedback, int]
"""Commanded torque (joints,) [N m], feedback added to it, and duration in samples."""

_Commands = Callable[[_Start], Iterator[list[_Piece]]]
"""Yields the commands that stop the arm in a given initial state, as one list of pieces for each variant."""


def stopping_distance(config: Config, plan: Plan, ensemble: Ensemble, velocity: Array) -> Stopping:
    """Simulate stops of both kinds, planned and passed, on a few arms of the ensemble; limits are crossed at up to
    `velocity` (joints,) [rad/s].
    """
    return Stopping(beyond_when_planned(config, plan, ensemble), beyond_when_passed(config, plan, ensemble, velocity))


def beyond_when_planned(config: Config, plan: Plan, ensemble: Ensemble) -> dict[Way, Array]:
    """Largest overshoot beyond the limits (joints,) [rad], by kind of stop, for stops at any moment of the planned
    motion.
    """
    stops = _Stops(config)
    ways = {
        Way.CUT: stops.cut,
        Way.BRAKED: stops.braked,
        Way.SILENT: stops.silent,
        Way.SILENT_BRAKE: stops.silent_brake,
    }
    goals = _planned_goals(config, plan)
    return _farthest(stops, ways, ensemble, lambda physics, scale: _planned_starts(config, physics, scale, goals))


def beyond_when_passed(
    config: Config, plan: Plan, ensemble: Ensemble, velocity: Array, pose: Array | None = None
) -> dict[Way, Array]:
    """Largest overshoot beyond the limits (joints,) [rad], by kind of stop, if a stop begins as a joint crosses a limit
    under the largest torque, at up to `velocity` (joints,) [rad/s].

    pose: pose at that moment (joints,) [rad]; by default, one joint is at a limit and the other anywhere in its range.
    """
    stops = _Stops(config)
    peak = np.abs(_planned_goals(config, plan)).max(axis=1)
    faster = velocity + GETS_FASTER * np.array([joint.velocity_limit for joint in config.joints])
    ways = {Way.CUT: stops.cut, Way.BRAKED: stops.braked}
    held = _farthest(stops, ways, ensemble, lambda physics, _: _limit_starts(config, physics, peak, velocity, pose))
    pushed = {Way.REVERSED: stops.reversed}
    return held | _farthest(
        stops, pushed, ensemble, lambda physics, _: _limit_starts(config, physics, peak, faster, pose)
    )


def _farthest(
    stops: "_Stops", ways: Mapping[Way, _Commands], ensemble: Ensemble, starts: Callable[[Physics, Array], list[_Start]]
) -> dict[Way, Array]:
    """The largest overshoot among a few arms and their initial states, by kind of stop (joints,) [rad]."""
    few = ensemble.first(_ARMS)

    def one(arm: int) -> list[Array]:
        physics, scale = few.physics[arm], few.torque_scale[arm]
        from_here = starts(physics, scale)
        return [stops.farthest(physics, scale, from_here, commands) for commands in ways.values()]

    with ThreadPoolExecutor(thread_count(_THREADS)) as threads:  # the compiled simulation releases the GIL
        worst = np.max(list(threads.map(one, range(few.size))), axis=0)
    return dict(zip(ways, worst, strict=True))


def _planned_goals(config: Config, plan: Plan) -> Array:
    """Commanded torque of the whole plan (joints, samples) [N m]. Each segment has only two periods, since more would
    add nothing.
    """
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    parts = []
    for segment in plan.segments:
        parts += [segment.ramp_in, segment.period_current, segment.period_current, segment.ramp_out]
    return np.ascontiguousarray((np.concatenate(parts) * constants).T)


def _planned_starts(config: Config, physics: Physics, scale: Array, goals: Array) -> list[_Start]:
    """States of the planned motion before it reaches a limit. Some are evenly spaced in time; the others are those from
    which the arm is likely to overshoot most.
    """
    rest = resting(np.array(config.arm.rest_pose))
    moved = respond(physics, rest, goals * scale[:, None], config.experiment.rate, _felt(config, scale), COARSE)
    until = _within_limits(config, moved)
    chosen = set(np.linspace(1, until - 1, _EVENLY).astype(int).tolist())
    for ahead in _AHEAD_S:
        carried = moved.position[:, 1:until] + ahead * moved.velocity[:, 1:until]
        chosen |= {1 + int(at) for at in (*carried.argmin(axis=1), *carried.argmax(axis=1))}
    return [
        _Start(
            np.stack((*_at(moved, at), moved.torque[:, at - 1], *_at(moved, at - 1))),
            moved.torque[:, at] / scale,
        )
        for at in sorted(chosen)
    ]


def _within_limits(config: Config, moved: Response) -> int:
    """Number of samples before the guard stops the motion because a limit is exceeded; at least two."""
    low, high = (np.array(side)[:, None] for side in zip(*(j.position_limit for j in config.joints), strict=True))
    fastest = np.array([joint.velocity_limit for joint in config.joints])[:, None]
    passed = (moved.position < low) | (moved.position > high) | (np.abs(moved.velocity) > fastest)
    first = np.flatnonzero(passed.any(axis=0))
    return max(2, int(first[0])) if first.size else passed.shape[1]


def _at(moved: Response, sample: int) -> tuple[Array, Array]:
    return moved.position[:, sample], moved.velocity[:, sample]


def _felt(config: Config, scale: Array) -> Feedback:
    return scaled_feedback(feedback_of(config), scale)


def _limit_starts(config: Config, physics: Physics, peak: Array, velocity: Array, pose: Array | None) -> list[_Start]:
    """Initial states with one joint driven outwards at its limit while the other moves at any speed or is jammed."""
    starts = []
    joints = range(len(config.joints))
    rest = config.arm.rest_pose
    for joint, outward in product(joints, (-1.0, 1.0)):
        limit = config.joints[joint].position_limit[0 if outward < 0 else 1]
        corners = product(*([limit] if k == joint else [rest[k], *config.joints[k].position_limit] for k in joints))
        speeds = [[outward] if k == joint else [-1.0, 0.0, 1.0] for k in joints]
        goal = outward * np.where(np.arange(len(joints)) == joint, peak, 0.0)
        for at in map(np.array, corners) if pose is None else [pose]:
            starts += [_Start(_moving(at, np.array(each) * velocity), goal) for each in product(*speeds)]
            if len(joints) == 2:
                handed = _handed_on(physics, at, joint, outward, velocity)
                starts.append(_Start(_moving(at, handed), goal, jammed=1 - joint))
    return starts


def _moving(pose: Array, velocity: Array) -> Array:
    state = resting(pose)
    state[1] = state[4] = velocity
    return state


def _handed_on(physics: Physics, pose: Array, joint: int, outward: float, velocity: Array) -> Array:
    """Velocities after the other joint has jammed and transferred its momentum to this joint instantly."""
    p = dict(zip(CONSTANTS, physics.vector.tolist(), strict=True))
    across = p["coupling"] * float(np.cos(pose[1]))
    shared = p["inertia_2"] + across
    own = (p["inertia_1"] + p["inertia_2"] + 2 * across, p["inertia_2"] + p["armature_2"])[joint]
    after = np.zeros_like(pose)
    after[joint] = outward * (velocity[joint] + abs(shared) / own * velocity[1 - joint])
    return after


def _held(physics: Physics, joint: int) -> Physics:
    """The arm with one joint locked, modelled by a very large rotor inertia."""
    vector = physics.vector.copy()
    vector[CONSTANTS.index(("inertia_1", "armature_2")[joint])] += _IMMOVABLE
    return Physics(vector, physics.delay, physics.lag)


class _Stops:
    """Commands over time from an initial state, for each kind of stop."""

    def __init__(self, config: Config) -> None:
        self._config = config
        rate = config.experiment.rate
        self._rate = rate
        self._low, self._high = np.array([joint.position_limit for joint in config.joints]).T
        constants = np.array([joint.torque_per_goal for joint in config.joints])
        self._clamp = feedback_of(config).limit
        nothing = np.zeros_like(constants)
        self._none = Feedback.none(len(config.joints))
        self._brake = Feedback(nothing, np.array(braking_gains(config)) * constants, nothing, self._clamp)
        off_for = round(LONGEST_S * rate)
        self._off: _Piece = (nothing, self._none, off_for)
        judged = [sample for after in _JUDGED_AFTER_S if 0 < (sample := round(after * rate)) < off_for]
        self._off_parts = np.diff([0, *judged, off_for]).tolist()
        self._braking = round(config.safety.damp_time * rate)
        self._heard_for = round(config.safety.watchdog * rate) + 1
        self._missed_for = math.ceil(missing_limit(config).seconds * rate) + _REACTION

    def farthest(self, physics: Physics, scale: Array, starts: list[_Start], commands: _Commands) -> Array:
        """The largest overshoot beyond a limit (joints,) [rad]."""
        reached = np.zeros_like(scale)
        limits = {jammed: self._boundary(physics, jammed) for jammed in {start.jammed for start in starts}}
        arms = {jammed: Simulator.of(each.physics, self._rate, COARSE) for jammed, each in limits.items()}
        for start in starts:
            for pieces in commands(start):
                for moved in self._moved(arms[start.jammed], limits[start.jammed], scale, start.state, pieces):
                    low, high = moved.position.min(axis=1), moved.position.max(axis=1)
                    reached = np.maximum(reached, np.maximum(self._low - low, high - self._high))
        return reached

    def _boundary(self, physics: Physics, jammed: int | None) -> Boundary:
        return boundary(physics if jammed is None else _held(physics, jammed), self._low, self._high)

    def _moved(
        self, arm: Simulator, limits: Boundary, scale: Array, state: Array, pieces: list[_Piece]
    ) -> Iterator[Response]:
        """Yield the motion from `state`, piece by piece, until the arm can no longer exceed its limits."""
        for piece in pieces:
            command, feedback, count = piece
            off = piece is self._off
            torque, felt = (command * scale)[:, None], scaled_feedback(feedback, scale)
            for samples in self._off_parts if off else (count,):
                held = np.empty((len(torque), samples))
                held[:] = torque
                moved = arm.respond(state, held, felt)
                state = moved.state
                yield moved
                if off and limits.holds(state[0], state[1]):
                    return

    def cut(self, start: _Start) -> Iterator[list[_Piece]]:
        yield [(start.goal, self._none, _REACTION), self._off]

    def braked(self, start: _Start) -> Iterator[list[_Piece]]:
        if self._braking and self._config.safety.stop == "damp":
            yield [(start.goal, self._none, _REACTION), (self._off[0], self._brake, self._braking), self._off]
        else:
            yield from self.cut(start)

    def reversed(self, start: _Start) -> Iterator[list[_Piece]]:
        pushed = np.clip(self._brake.damping * start.state[1], -self._clamp, self._clamp)
        yield [(start.goal, self._none, _REACTION), (pushed, self._none, NOTICED_AFTER), self._off]

    def silent(self, start: _Start) -> Iterator[list[_Piece]]:
        """Either all servos keep their goals until their watchdogs trip, or only one servo does, and the torque of the
        others is cut earlier.
        """
        kept = (start.goal, self._none, self._heard_for)
        yield [kept, self._off]
        for silent in range(start.goal.size if start.goal.size > 1 else 0):
            alone = np.where(np.arange(start.goal.size) == silent, start.goal, 0.0)
            first = min(self._missed_for, self._heard_for - 1)
            yield [(start.goal, self._none, first), (alone, self._none, self._heard_for - first), self._off]

    def silent_brake(self, start: _Start) -> Iterator[list[_Piece]]:
        goal = np.clip(-self._brake.damping * start.state[1], -self._clamp, self._clamp)
        yield [(goal, self._none, self._heard_for), self._off]
