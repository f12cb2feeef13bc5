"""Excitation of a spatial arm: a joint path, played as the feed-forward torque that its description gives.

The stabiliser pulls towards the rest pose all the time. So that its spring and damper hold the arm to the path instead,
what they will add is taken off beforehand: goal = feed-forward + stiffness (path - rest) + damping path velocity. The
way from the rest pose to the path and back is part of what is played.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hil.config.chain import base_gravity, described_arm
from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimator.chain.base_parameters import BaseParameters
from hil.estimator.chain.dynamics import inverse_dynamics
from hil.estimator.chain.excitation import Path, design_path
from hil.estimator.chain.geometry import Chain
from hil.estimator.chain.prior import Prior
from hil.estimator.excitation.multisine import Multisine
from hil.plan.plan import Plan, Segment, make_plan, plan_with

Array = NDArray[np.float64]

ARMATURE = 0.01  # kg m^2: what the feed-forward supposes of every rotor
ROUGH_FRICTION = 0.02  # of a joint's largest torque: what the feed-forward supposes
SLOW = 0.1  # rad/s: where the supposed friction turns round
SETTLE_IN = 0.3  # s in which the feed-forward comes and goes


@dataclass(frozen=True)
class PathSegment(Segment):
    """A path, its multisine being the torque that is played for it; `way` (samples, joints) [A] leads there."""

    way: Array
    back: Array

    @property
    def ramp_in(self) -> Array:
        return self.way

    @property
    def ramp_out(self) -> Array:
        return self.back


@dataclass(frozen=True)
class KnownChain:
    """What the configuration says of an arm in space before anything is identified."""

    base: BaseParameters
    prior: Prior
    described: Array
    """All parameters of the description (11 joints,) [SI]."""


def known_chain(config: Config) -> KnownChain:
    """From the configuration's URDF; raises ArmFileError."""
    arm = described_arm(config)
    base = BaseParameters.of(Chain(*arm.geometry, base_gravity(config)))
    rotors = np.full(len(arm.joints), ARMATURE)
    return KnownChain(base, Prior.of(base, arm.parameters), np.column_stack((arm.parameters, rotors)).reshape(-1))


def plan_of(config: Config) -> Plan:
    """What this configuration's arm will play; raises ConfigError."""
    return make_chain_plan(config) if config.is_chain else make_plan(config)


def make_chain_plan(config: Config) -> Plan:
    """Design the paths; the same seed gives the same plan. Raises ConfigError."""
    experiment = config.experiment
    if not config.is_fake:
        raise ConfigError(
            f"{config.path}: port.url = {config.port.url!r}: experiments on real spatial arms are not supported yet: "
            "there is no collision check and no safe way to lower the arm after a stop. The fake arm can be "
            "identified, and "
            "`hil scan` and `hil check` work with real servos."
        )
    if config.joint_path is None or experiment.band is None:
        raise ConfigError(f"{config.path}: joint_path is missing: [joint_path] with centre, swing and speed per joint.")
    known = known_chain(config)
    return plan_with(config, partial(_segment, known))


def _segment(known: KnownChain, config: Config, role: str, seed: int) -> PathSegment:
    experiment, wanted = config.experiment, config.joint_path
    assert wanted is not None
    assert experiment.band is not None  # checked above
    path = design_path(
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
    torque = _torque(config, known, path)
    _check_torque(config, known, path)
    way, back = _ways(config, path)
    faded = _fade(round(experiment.ramp * experiment.rate), experiment.rate)
    there = _torque(config, known, way, faded)
    home = _torque(config, known, back, faded[::-1])
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
    return PathSegment(role, multisine, goals, len(there.T), there.T / constants, home.T / constants)


def _torque(config: Config, known: KnownChain, path: Path, share: Array | float = 1.0) -> Array:
    """To be played for a path (joints, samples) [N m], `share` of its feed-forward."""
    assert config.stabiliser is not None
    stiffness, damping = (np.array(each)[:, None] for each in (config.stabiliser.stiffness, config.stabiliser.damping))
    rest = np.array(config.arm.rest_pose)[:, None]
    held: Array = stiffness * (path.position - rest) + damping * path.velocity
    return held + share * _feed_forward(config, known, path)


def _feed_forward(config: Config, known: KnownChain, path: Path) -> Array:
    most = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])[:, None]
    rigid = inverse_dynamics(known.base.chain, known.described, path.position, path.velocity, path.acceleration)
    return rigid + ROUGH_FRICTION * most * (np.tanh(path.velocity / SLOW) + path.velocity)


def _check_torque(config: Config, known: KnownChain, path: Path) -> None:
    """Check that the path leaves the motors headroom for errors of the description."""
    peaks = np.abs(_feed_forward(config, known, path)).max(axis=1)
    for joint, peak in zip(config.joints, peaks.tolist(), strict=True):
        most = joint.goal_limit * joint.torque_per_goal
        if peak > 0.8 * most:
            raise ConfigError(
                f"{config.path}: joint_path: {joint.name!r} needs about {peak:.3g} N m for this path but has "
                f"{most:.3g}: "
                "lower joint_path.speed or swing, or raise its current_limit."
            )


def _ways(config: Config, path: Path) -> tuple[Path, Path]:
    """From the rest pose into the path, which runs on all the while, and out of it back: no joint leaves the range
    between the two."""
    count = max(2, round(config.experiment.ramp * config.experiment.rate))
    samples = path.position.shape[1]
    before, after = np.arange(-count, 0) % samples, np.arange(count) % samples
    seconds = count / config.experiment.rate
    s = np.arange(count) / count
    return _blended(config, path, before, s, seconds), _blended(config, path, after, 1.0 - s, -seconds)


def _blended(config: Config, path: Path, at: NDArray[np.int64], s: Array, seconds: float) -> Path:
    """Between the rest pose, at s = 0, and the path, at 1, smooth to the second derivative."""
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
    """From 0 to 1 in SETTLE_IN, then 1."""
    s = np.clip(np.arange(max(2, count)) / (SETTLE_IN * rate), 0.0, 1.0)
    fade: Array = s * s * (3.0 - 2.0 * s)
    return fade
