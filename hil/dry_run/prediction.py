"""Simulate the experiment on an ensemble of arms, and compare the predicted peaks with each limit.

Every arm receives the plan's goal currents, including the ramps, rounded to the servos' ticks, for as many periods as
it takes to settle. Peaks are fractions of the distance from rest to the limit; the guard would stop an arm whose
peak reaches 1.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from math import erfc, sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.rollout import commands_of, simulate_experiment
from hil.estimator.arrays import Array
from hil.estimator.simulation.closed_loop import Feedback
from hil.estimator.simulation.many_arms import LOWEST, TORQUE, Commands, ManyArms, SettlingRule
from hil.plan.plan import Plan
from hil.plan.stabiliser import feedback_of

QUANTITIES = ("lowest position", "highest position", "velocity", "current", "torque", "power")
UNITS = ("rad", "rad", "rad/s", "A", "N m", "W")
GUARDED = 3
"""The guard stops the arm at the limits of the first GUARDED quantities. Current is clamped instead; torque and power
follow from the other quantities.
"""

QUANTILE = 0.99
_ARMS_A_TASK = 16
"""Number of arms that one task of an executor simulates."""
_LEAST_SPREAD = 2e-3


@dataclass(frozen=True)
class Prediction:
    """The prediction of a dry run.

    values: extreme values of every arm (arms, quantities, joints), in the order of QUANTITIES and in UNITS. shares: the
    same values as fractions of the distance from rest to the limit. limits: limits (quantities, joints). settled_after:
    number of periods until each arm settled (arms,), 0 if it took more than max_settling_periods. shown: positions over
    time of a few arms (arms, joints, samples) [rad], padded with NaN. rest: rest pose (joints,) [rad]. rate: sampling
    rate [Hz]. centre: centre of a path (joints,) [rad]; distances to a position limit are then measured from `rest`
    or `centre`, whichever is farther from that limit.
    """

    values: Array
    shares: Array
    limits: Array
    settled_after: NDArray[np.int64]
    shown: Array
    rest: Array
    rate: float
    centre: Array | None = None

    @property
    def median(self) -> Array:
        """Median peaks over the arms (quantities, joints)."""
        middle: Array = np.median(self.values, axis=0)
        return middle

    @property
    def quantile(self) -> Array:
        """Bounds that contain all peaks of 99 out of 100 arms (quantities, joints).

        All bounds are the same number of standard deviations above their medians, so that they change smoothly with the
        amplitude.
        """
        return self._value_at(self.share_at(self._simultaneous()))

    def exceeding(self, chance: float) -> Array:
        """Peaks that show why limits are exceeded more often than `chance` allows (quantities, joints): `quantile` if
        that exceeds the limit, otherwise the values at `shares_with(chance)`.
        """
        usual = self.share_at(self._simultaneous())
        return self._value_at(np.where(usual >= 1.0, usual, self.shares_with(chance)))

    def shares_with(self, chance: float) -> Array:
        """Fractions of the limits (quantities, joints) that are exceeded with a total probability of `chance` or, if
        larger, the fractions that the worst arm reaches.
        """
        foreseen = self.share_at(NormalDist().inv_cdf(1 - chance / (2 * GUARDED)))
        return np.asarray(np.maximum(foreseen, self.shares.max(axis=0)))

    def _value_at(self, shares: Array) -> Array:
        return np.asarray(self.origin + shares * (self.limits - self.origin))

    @property
    def stop_chance(self) -> float:
        """Probability that the guard stops the run: the fraction of arms that it stops or, if larger, the tail
        estimate.
        """
        counted = float(np.mean((self.shares[:, :GUARDED] >= 1).any(axis=(1, 2))))
        return max(counted, min(1.0, float(self.limit_chance[:GUARDED].sum())))

    @property
    def limit_chance(self) -> Array:
        """Probability that a quantity exceeds its limit (quantities, joints), assuming a normal upper tail."""
        middle, spread = self._middle()
        return np.asarray([[0.5 * erfc(z / sqrt(2)) for z in row] for row in ((1 - middle) / spread).tolist()])

    def share_at(self, deviations: float) -> Array:
        """Fractions of the limits (quantities, joints) at this number of standard deviations above the median."""
        middle, spread = self._middle()
        return np.asarray(middle + deviations * spread)

    @property
    def origin(self) -> Array:
        """The values from which distances to the limits are measured (quantities, joints)."""
        origin = np.zeros_like(self.limits)
        centre = self.rest if self.centre is None else self.centre
        origin[0], origin[1] = np.maximum(self.rest, centre), np.minimum(self.rest, centre)
        return origin

    def _middle(self) -> tuple[Array, Array]:
        """Medians of the shares, and their spreads above the medians (quantities, joints). The spreads are computed
        from the shares above the median only, because the peaks are skewed towards the limit.
        """
        middle = np.median(self.shares, axis=0)
        above = np.maximum(self.shares - middle, 0.0)
        return middle, np.maximum(np.sqrt(2 * np.mean(above**2, axis=0)), _LEAST_SPREAD)

    def _simultaneous(self) -> float:
        middle, spread = self._middle()
        worst = ((self.shares - middle) / spread)[:, :GUARDED].max(axis=(1, 2))
        return float(np.quantile(worst, QUANTILE, method="higher"))


def quantities_of(joint: JointConfig) -> tuple[tuple[str, str], ...]:
    """Names and units of a prediction's rows for one joint; a goal is a voltage if the joint is driven by PWM."""
    named = tuple(zip(QUANTITIES, UNITS, strict=True))
    if joint.drive_mode is not Mode.PWM:
        return named
    return tuple(("voltage", "V") if name == "current" else (name, unit) for name, unit in named)


def predict(
    config: Config,
    plan: Plan,
    ensemble: Ensemble,
    *,
    pose: Array | None = None,
    briefly: bool = False,
    shown: int = 0,
    executor: Executor | None = None,
) -> Prediction:
    """Simulate `plan` on every arm of the ensemble.

    Args:
        config: configuration of the arm.
        plan: the experiment to simulate.
        ensemble: the arms.
        pose: where the arm starts at rest (joints,) [rad]; by default the rest pose.
        briefly: simulate only one period of each multisine; used during a search.
        shown: number of arms whose motion is stored.
        executor: executor that simulates the arms in groups; it does not change the result.
    """
    commands = [commands_of(config, segment) for segment in plan.segments]
    start = np.array(config.arm.rest_pose) if pose is None else pose
    poses = np.tile(start, (ensemble.size, 1))
    feedback = feedback_of(config)
    arms = ManyArms(ensemble.physics, ensemble.torque_scale, poses, feedback)
    if briefly:
        each = [_peaks(arms, [command], plan.rate, SettlingRule(0.0, 0, 1), executor)[0] for command in commands]
        peaks = _extreme(np.stack(each))
        settled_after = np.zeros(ensemble.size, dtype=np.int64)
    else:
        settling = SettlingRule(plan.settle_within, plan.max_settling_periods, plan.periods)
        peaks, settled_after = _peaks(arms, commands, plan.rate, settling, executor)
    limits, rest = limits_of(config), np.array(config.arm.rest_pose)
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    values = np.insert(peaks, TORQUE, peaks[:, TORQUE] / constant, axis=1)
    motions = [
        simulate_experiment(plan, commands, physics, scale, scaled_feedback(feedback, scale), start).position
        for physics, scale in zip(ensemble.physics[:shown], ensemble.torque_scale[:shown], strict=True)
    ]
    return Prediction(
        values, _shares(values, limits, rest), limits, settled_after, _side_by_side(motions), rest, plan.rate
    )


def _peaks(
    arms: ManyArms, commands: Sequence[Commands], rate: float, settling: SettlingRule, executor: Executor | None
) -> tuple[Array, NDArray[np.int64]]:
    """Call `ManyArms.peaks`, distributed over the executor if there is one; arms are simulated independently."""
    if executor is None:
        return arms.peaks(commands, rate, settling)
    parts = [arms.part(first, first + _ARMS_A_TASK) for first in range(0, len(arms.physics), _ARMS_A_TASK)]
    count = len(parts)
    found = list(executor.map(ManyArms.peaks, parts, [commands] * count, [rate] * count, [settling] * count))
    return np.concatenate([peaks for peaks, _ in found]), np.concatenate([settled for _, settled in found])


def _extreme(peaks: Array) -> Array:
    """Extremes of each peak over several multisines: (multisines, arms, peaks, joints) to (arms, peaks, joints)."""
    most: Array = peaks.max(axis=0)
    most[:, LOWEST] = peaks[:, :, LOWEST].min(axis=0)
    return most


def limits_of(config: Config) -> Array:
    """Limits (quantities, joints), in the order of QUANTITIES and in UNITS."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    velocity = np.array([joint.velocity_limit for joint in config.joints])
    current = np.array([joint.goal_limit for joint in config.joints])
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    torque = current * constant
    return np.stack((low, high, velocity, current, torque, torque * velocity))


def peaks_of(config: Config, position: Array, velocity: Array, current: Array) -> Array:
    """Extreme values (quantities, joints) of a motion (joints, samples) [rad, rad/s, A]; NaN is ignored."""
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    torque = current * constant[:, None]
    return np.stack(
        (
            np.nanmin(position, axis=1),
            np.nanmax(position, axis=1),
            np.nanmax(np.abs(velocity), axis=1),
            np.nanmax(np.abs(current), axis=1),
            np.nanmax(np.abs(torque), axis=1),
            np.nanmax(np.abs(torque * velocity), axis=1),
        )
    )


def scaled_feedback(feedback: Feedback, scale: Array) -> Feedback:
    """The effective feedback for an arm whose torque constants are `scale` (joints,) times the assumed ones."""
    return Feedback(feedback.stiffness * scale, feedback.damping * scale, feedback.pose, feedback.limit * scale)


def _side_by_side(positions: list[Array]) -> Array:
    """Stack positions (joints, samples) of different lengths, padded with NaN: (arms, joints, samples) [rad]."""
    if not positions:
        return np.empty((0, 0, 0), dtype=np.float32)
    longest = max(position.shape[1] for position in positions)
    together = np.full((len(positions), positions[0].shape[0], longest), np.nan, dtype=np.float32)
    for row, position in zip(together, positions, strict=True):
        row[:, : position.shape[1]] = position
    return together


def _shares(values: Array, limits: Array, rest: Array) -> Array:
    below = (rest - values[:, 0]) / (rest - limits[0])
    above = (values[:, 1] - rest) / (limits[1] - rest)
    return np.concatenate((below[:, None], above[:, None], np.abs(values[:, 2:] / limits[2:])), axis=1)
