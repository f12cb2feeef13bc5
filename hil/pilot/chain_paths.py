"""Paths for the runs of a spatial arm's pilot. They are designed once for all steps, and scaled down for the early
steps.
"""

from dataclasses import dataclass

import numpy as np

from hil.clearance.space import Space
from hil.config.chain import DEFAULT_BAND, POSITION_RESERVE, described_arm, doubted_inertias
from hil.config.schema import Config
from hil.errors import NoSafeTorque
from hil.estimator.arrays import Array
from hil.estimator.chain.excitation.fourier_path import Path
from hil.estimator.chain.excitation.path_design import Design, PathDesigner, PathLimits
from hil.estimator.errors import ExcitationError
from hil.estimator.progress import Tell
from hil.plan.chain_model import ChainTorque, known_chain, limit_names, torque_limits
from hil.plan.chain_plan import check_rest_pose, path_plan
from hil.plan.plan import HELD_OUT, Plan
from hil.plan.stabiliser import check_rate

# Highest speed between rest pose and path: the smaller of this [rad/s] and this fraction of velocity_limit.
RAMP_SPEED = 1.2
RAMP_SPEED_SHARE = 0.35
_PEAK = 1.875
_WAY_POSES = 40
_POSES = 200
"""Number of random poses in which the described arm's weight is compared with its torque limits."""


@dataclass(frozen=True)
class Reserve:
    """Margins that a path keeps from the limits and from obstacles, to allow for errors of the assumed model.

    position: fraction of a joint's range that stays free at each limit. speed, torque: fractions of the limits that
    the path may use. clearance: distance from obstacles in addition to the configured margin [m]; transitions from and
    to the rest pose need not keep this additional distance.
    """

    position: float = POSITION_RESERVE
    speed: float = 0.6
    torque: float = 0.65
    clearance: float = 0.01

    def larger(self, shortage: float) -> "Reserve":
        """Return a larger reserve. shortage: by how much the predicted clearance is too small [m]; 0 if it is
        sufficient.
        """
        position = min(MORE * self.position, MOST_POSITION)
        return Reserve(position, self.speed / MORE, self.torque / MORE, self.clearance + shortage)


MORE = 1.4
MOST_POSITION = 0.3
"""Largest value of Reserve.position; a value of 0.5 would leave nothing of a joint's range."""
RESERVE = Reserve()


@dataclass(frozen=True)
class Paths:
    """The designed paths.

    identify: optimised path. held_out: wide path around the same centre, with random phases. reserve: margins
    that both paths keep.
    """

    config: Config
    designer: PathDesigner
    identify: Design
    held_out: Design
    reserve: Reserve = RESERVE

    @classmethod
    def of(cls, config: Config, thought: ChainTorque, reserve: Reserve = RESERVE, tell: Tell | None = None) -> "Paths":
        """Design the paths. Raises NoSafeTorque if no path is safe, ConfigError, or ArmFileError.

        thought: assumed model of the arm. tell: called with the number of steps done and the total number.
        """
        check_rest_pose(config)
        known, space = known_chain(config), Space.of(config)
        most, rest = reserve.torque * torque_limits(config), np.array(config.arm.rest_pose)
        low, high = np.array([joint.position_limit for joint in config.joints]).T
        speed = reserve.speed * np.array([joint.velocity_limit for joint in config.joints])
        room = reserve.position * (high - low)
        experiment = config.experiment
        assert experiment.band is not None  # set by `chain_config`

        def allowed(path: Path) -> bool:
            if (np.abs(thought.of(path)).max(axis=1) > most).any():
                return False
            if not space.has_reserve(path.position, reserve.clearance):
                return False
            return bool(
                space.room(_ways(path, rest, experiment.ramp / experiment.period), on_the_way=True).min() >= 0.0
            )

        limits = PathLimits(low + room, high - room, speed, allowed)
        try:
            designer = PathDesigner(
                known.base,
                known.prior,
                thought.coulomb,
                experiment.rate,
                experiment.period,
                experiment.band[1],
                limits,
            )
            best = designer.design(experiment.seed, tell=tell)
            other = designer.widest(best.centre, experiment.seed + 1)
        except ExcitationError as error:
            suspected = _of_the_description(config, thought, most)
            raise NoSafeTorque(
                f"{config.path}: {error}. {suspected}{'Otherwise, widen' if suspected else 'Widen'} position_limit, "
                f"raise {limit_names(config)}, correct [clearance], or set [joint_path] and pilot = false."
            ) from error
        return cls(config, designer, best, other, reserve)

    def amplitude_over(self, other: "Paths") -> float:
        """Return the largest ratio of a joint's peak excursion or speed in these paths to that in the `other` paths."""
        pairs = (self.identify, other.identify), (self.held_out, other.held_out)
        return max(float((_peaks(mine.path) / _peaks(its.path)).max()) for mine, its in pairs)

    def plan(self, config: Config, thought: ChainTorque, share: float) -> Plan:
        """Plan both paths at the fraction `share` of their amplitude. thought: assumed model of the arm."""

        def path(_: Config, role: str, __: int) -> Path:
            return self.designer.scaled(self.held_out if role == HELD_OUT else self.identify, share)

        return path_plan(config, thought, path)


def _peaks(path: Path) -> Array:
    """Peak excursion from the centre [rad] and peak speed [rad/s] of each joint (2, joints)."""
    excursion = path.position - path.position.mean(axis=1, keepdims=True)
    peaks: Array = np.maximum(np.abs(np.stack((excursion, path.velocity))).max(axis=2), 1e-9)
    return peaks


def chain_config(config: Config) -> Config:
    """The configuration with a frequency band, and with a ramp long enough to move slowly to any pose within the
    limits.

    Raises ConfigError if the rate is too low for a configured stabiliser.
    """
    check_rate(config)
    experiment = config.experiment
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    rest = np.array(config.arm.rest_pose)
    farthest = np.maximum(high - rest, rest - low) * (1.0 - RESERVE.position)
    fastest = np.minimum(RAMP_SPEED, RAMP_SPEED_SHARE * np.array([joint.velocity_limit for joint in config.joints]))
    ramp = max(experiment.ramp, float((_PEAK * farthest / fastest).max()))
    band = experiment.band or list(DEFAULT_BAND)
    ramp = float(np.ceil(min(ramp, 0.6 * experiment.period, 60.0) * 10) / 10)
    return config.model_copy(update={"experiment": experiment.model_copy(update={"band": band, "ramp": ramp})})


def _of_the_description(config: Config, thought: ChainTorque, most: Array) -> str:
    """Say why the masses and inertias of the description may be the reason that no path is allowed; "" if nothing
    suggests it.

    most: torque that a path may require (joints,) [N m].
    """
    arm = described_arm(config)
    doubts = doubted_inertias(arm)
    said = [_too_heavy(config, arm.path.name, thought, most)]
    if doubts:
        more = f" (`hil check` lists {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        said.append(f"The description may be the cause{more}: {doubts[0]}")
    return "".join(f"{sentence} " for sentence in said if sentence)


def _too_heavy(config: Config, name: str, thought: ChainTorque, most: Array) -> str:
    """Say so if the described arm, even at rest, requires too much torque in all of many random poses.

    name: name of the description's file.
    """
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    random = np.random.default_rng(config.experiment.seed)
    poses = random.uniform(low[:, None], high[:, None], (len(low), _POSES))
    still = np.zeros_like(poses)
    holding = np.abs(thought.of(Path(poses, still, still)))
    if not (holding > most[:, None]).any(axis=0).all():
        return ""
    joint = int(np.argmax((holding / most[:, None]).mean(axis=1)))
    return (
        f"According to {name}, gravity alone requires more torque than a path may use in each of {_POSES} random "
        f"poses: on average {holding[joint].mean():.2g} N m of {most[joint]:.2g} N m at "
        f"{config.joints[joint].joint.title}. Check the masses and centres of mass in {name}."
    )


def _ways(path: Path, rest: Array, share: float) -> Array:
    """Poses on the transitions between rest pose and path (joints, poses), as blended by `hil.plan.chain_plan`."""
    samples = path.position.shape[1]
    s = np.linspace(0.0, 1.0, _WAY_POSES)
    blend = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    before = np.round((s - 1.0) * share * samples).astype(int) % samples
    after = np.round((1.0 - s) * share * samples).astype(int) % samples
    ways = [rest[:, None] + blend * (path.position[:, at] - rest[:, None]) for at in (before, after)]
    return np.concatenate(ways, axis=1)
