"""Excitation of a spatial arm: joint paths, commanded as the feed-forward torque of the assumed model.

The stabiliser always pulls towards the rest pose. To hold the arm to the path instead, its contribution is compensated
in advance:

    goal = feed-forward + stiffness * (path - rest) + damping * path velocity

The transitions from the rest pose to the path and back are part of the plan.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hil.clearance.space import Space
from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimator.arrays import Array
from hil.estimator.chain.excitation.fourier_path import Path, design_path
from hil.estimator.excitation.multisine import Multisine
from hil.plan.chain_model import ChainTorque, KnownChain, described_torque, known_chain, torque_limits
from hil.plan.plan import Plan, Segment, make_plan, plan_with
from hil.plan.stabiliser import check_rate

SETTLE_IN = 0.3  # s over which the feed-forward is faded in and out
TORQUE_SHARE = 0.8  # fraction of a joint's torque limit that a path may use; the remainder allows for model errors


@dataclass(frozen=True)
class PathSegment(Segment):
    """A segment that follows a path; its multisine is the torque that is commanded for the path.

    way, back: goals of the transitions from and to the rest pose (samples, joints) [A]. paths: the desired motions
    (transition, period, transition back). thought: the assumed model from which the torque was computed. peaks: largest
    goal for the path without the stabiliser (joints,) [A].
    """

    way: Array
    back: Array
    paths: tuple[Path, Path, Path]
    thought: ChainTorque
    peaks: Array

    @property
    def peak_goal(self) -> Array:
        return self.peaks

    @property
    def ramp_in(self) -> Array:
        return self.way

    @property
    def ramp_out(self) -> Array:
        return self.back


class NoHeadroom(ConfigError):
    """A path requires too much of a joint's available torque."""


def plan_of(config: Config) -> Plan:
    """Make the plan for the configured arm. Raises ConfigError."""
    return make_chain_plan(config) if config.is_chain else make_plan(config)


def missing_path(config: Config) -> str:
    """Return advice if [joint_path] is missing, which a spatial arm needs if there is no pilot; otherwise ""."""
    if config.joint_path is not None:
        return ""
    return (
        "joint_path is missing: give [joint_path] with centre, swing and speed per joint, or set "
        "experiment.pilot = true, which finds them."
    )


def make_chain_plan(config: Config) -> Plan:
    """Design the paths; the same seed gives the same plan. Raises ConfigError."""
    if why := missing_path(config):
        raise ConfigError(f"{config.path}: {why}")
    check_rate(config)
    known = known_chain(config)
    return path_plan(config, described_torque(config, known), partial(_designed, known))


def path_plan(config: Config, thought: ChainTorque, path: Callable[[Config, str, int], Path]) -> Plan:
    """Plan the paths that `path` returns for each role and seed, using the assumed model `thought`. Raises ConfigError
    if a path needs too much torque.
    """

    def segment(config: Config, role: str, seed: int) -> PathSegment:
        return path_segment(config, thought, role, path(config, role, seed))

    plan = plan_with(config, segment)
    return replace(plan, lower_samples=lowering_samples(config))


def lowering_samples(config: Config) -> int:
    """Maximum number of samples for lowering a stopped arm, including braking and coming to rest."""
    safety = config.safety
    return round((safety.lower_time + 1.0 + 2.0 * SETTLE_IN) * config.experiment.rate)


def path_segment(config: Config, thought: ChainTorque, role: str, path: Path) -> PathSegment:
    """Plan one path with its transitions from and to the rest pose. thought: assumed model of the arm. Raises
    ConfigError if the path needs too much torque.
    """
    experiment = config.experiment
    assert experiment.band is not None  # checked with the configuration
    torque = path_torque(config, thought, path)
    _check_torque(config, thought, path)
    way, back = _ways(config, path)
    faded = _fade(round(experiment.ramp * experiment.rate), experiment.rate)
    there = path_torque(config, thought, way, faded)
    home = path_torque(config, thought, back, faded[::-1])
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    count = int(np.floor(experiment.band[1] * experiment.period + 1e-9))
    lines = tuple(tuple(range(1, count + 1)) for _ in config.joints)
    spectra = 2.0 * np.fft.rfft(torque, axis=1)[:, 1 : count + 1] / torque.shape[1]
    multisine = Multisine(
        experiment.rate,
        experiment.period,
        lines,
        tuple(tuple(np.abs(row).tolist()) for row in spectra),
        tuple(tuple(np.angle(row).tolist()) for row in spectra),
        torque,
    )
    goals = torque.T / constants
    ways = there.T / constants, home.T / constants
    peaks = np.abs(thought.of(path)).max(axis=1) / constants
    return PathSegment(role, multisine, goals, len(there.T), *ways, (way, path, back), thought, peaks)


def path_torque(config: Config, thought: ChainTorque, path: Path, share: Array | float = 1.0) -> Array:
    """Torque to command for a path (joints, samples) [N m], which compensates the stabiliser's pull towards the rest
    pose.

    thought: assumed model of the arm. share: factor applied to the feed-forward.
    """
    assert config.stabiliser is not None
    stiffness, damping = (np.array(each)[:, None] for each in (config.stabiliser.stiffness, config.stabiliser.damping))
    rest = np.array(config.arm.rest_pose)[:, None]
    held: Array = stiffness * (path.position - rest) + damping * path.velocity
    return held + share * thought.of(path)


def check_rest_pose(config: Config) -> None:
    """Raise ConfigError if, in the rest pose, parts of the arm would intersect each other, the floor or a box."""
    if wrong := Space.of(config).wrong_rest_pose():
        raise ConfigError(f"{config.path}: {wrong}.")


def check_clearance(config: Config, plan: Plan) -> None:
    """Raise ConfigError if the desired motion itself has too little clearance; only a dry run predicts the actual
    motion.
    """
    check_rest_pose(config)
    space = Space.of(config)
    for segment in plan.segments:
        assert isinstance(segment, PathSegment)
        for motion, on_the_way in zip(segment.paths, (True, False, True), strict=True):
            nearest = space.nearest(motion.position, on_the_way)
            if nearest.room < 0.0:
                raise ConfigError(
                    f"{config.path}: the path has too little clearance: {nearest}; at least "
                    f"{1e3 * nearest.needed:.0f} mm is required. Move joint_path.centre, "
                    "lower joint_path.swing, or correct [clearance] and the URDF's collision geometry; "
                    "`hil dry-run` shows where."
                )


def _designed(known: KnownChain, config: Config, role: str, seed: int) -> Path:
    del role
    experiment, wanted = config.experiment, config.joint_path
    assert wanted is not None
    assert experiment.band is not None  # checked before
    return design_path(
        known.base,
        known.prior,
        experiment.rate,
        experiment.period,
        experiment.band[1],
        np.array(wanted.centre),
        np.array(wanted.swing),
        np.array(wanted.speed),
        seed,
    )


def _check_torque(config: Config, thought: ChainTorque, path: Path) -> None:
    peaks, limits = np.abs(thought.of(path)).max(axis=1), torque_limits(config)
    # Without [joint_path], the path is designed, and its amplitude is searched.
    where, slower = ("joint_path: ", "lower joint_path.speed or swing, or ") if config.joint_path else ("", "")
    for joint, peak, most in zip(config.joints, peaks.tolist(), limits.tolist(), strict=True):
        if peak > TORQUE_SHARE * most:
            raise NoHeadroom(
                f"{config.path}: {where}{joint.name!r} needs about {peak:.3g} N m for this path, more than "
                f"{100 * TORQUE_SHARE:.0f} % of its limit of {most:.3g} N m. That leaves too little margin for errors "
                f"in the described masses: {slower}raise its {joint.goal_limit_name}."
            )


def _ways(config: Config, path: Path) -> tuple[Path, Path]:
    """Transitions from rest to the motion along the path, and back to rest. Each joint stays between its rest angle and
    its angle on the path.
    """
    count = max(2, round(config.experiment.ramp * config.experiment.rate))
    samples = path.position.shape[1]
    before, after = np.arange(-count, 0) % samples, np.arange(count) % samples
    seconds = count / config.experiment.rate
    s = np.arange(count) / count
    return _blended(config, path, before, s, seconds), _blended(config, path, after, 1.0 - s, -seconds)


def _blended(config: Config, path: Path, at: NDArray[np.int64], s: Array, seconds: float) -> Path:
    """Blend of the rest pose (s = 0) and the path (s = 1) with continuous second derivatives."""
    share = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    slope = 30.0 * s**2 * (1.0 - s) ** 2 / seconds
    bend = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / seconds**2
    away = path.position[:, at] - np.array(config.arm.rest_pose)[:, None]
    velocity, acceleration = path.velocity[:, at], path.acceleration[:, at]
    return Path(
        np.array(config.arm.rest_pose)[:, None] + share * away,
        share * velocity + slope * away,
        share * acceleration + 2.0 * slope * velocity + bend * away,
    )


def _fade(count: int, rate: float) -> Array:
    """A factor that rises smoothly from 0 to 1 within SETTLE_IN and then stays at 1."""
    s = np.clip(np.arange(max(2, count)) / (SETTLE_IN * rate), 0.0, 1.0)
    fade: Array = s * s * (3.0 - 2.0 * s)
    return fade
