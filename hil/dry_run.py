"""The experiment simulated on an ensemble of arms: what will be reached, against each limit.

Every arm of the ensemble gets the very goal currents of the plan, rounded to the servos' ticks, ramps included, through
lag and stabiliser. Peaks are compared as shares of the way to their limit; an arm with any share of 1 or more is one
that the guard would have stopped.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.servo_model import Mode
from estimator.closed_loop import Feedback, respond, resting
from estimator.physics import Physics
from hil.config import Config
from hil.ensemble import Ensemble
from hil.plan import Plan, Segment
from hil.settled import settling_difference
from hil.stabiliser import feedback_of

Array = NDArray[np.float64]

QUANTITIES = ("lowest position", "highest position", "velocity", "current", "torque", "power")
UNITS = ("rad", "rad", "rad/s", "A", "N m", "W")
GUARDED = 3
"""The first so many have a limit at which the guard stops; a current is clamped, torque and power follow."""

QUANTILE = 0.99
_LEAST_SPREAD = 2e-3
_THREADS = 2
_SHOWN_ARMS = 30


@dataclass(frozen=True)
class Peaks:
    """What one arm reached: extreme values (quantities, joints), periods until settled (0: not within those
    simulated), and, where kept, positions over time (joints, samples) [rad].
    """

    values: Array
    settled_after: int
    position: Array | None


@dataclass(frozen=True)
class Prediction:
    """What a dry run foresees.

    values: extreme values of every arm (arms, quantities, joints), in QUANTITIES and UNITS. shares: the same as shares
    of the way from rest to the limit. limits: (quantities, joints). settled_after: periods, per arm, 0 where more than
    were simulated. shown: positions over time of a few arms (arms, joints, samples) [rad].
    """

    values: Array
    shares: Array
    limits: Array
    settled_after: NDArray[np.int64]
    shown: Array
    rest: Array
    rate: float

    @property
    def median(self) -> Array:
        """(quantities, joints)."""
        middle: Array = np.median(self.values, axis=0)
        return middle

    @property
    def quantile(self) -> Array:
        """Values that all peaks of an arm together stay within, in 99 of 100 arms (quantities, joints).

        One common number of deviations above the medians, so that it moves smoothly with the amplitude.
        """
        shares = self.share_at(self._simultaneous())
        toward = self.limits - self._origin
        return np.asarray(self._origin + shares * toward)

    @property
    def stop_chance(self) -> float:
        """Chance that the guard stops the run: counted, or by the tail of the peaks, whichever is more."""
        counted = float(np.mean((self.shares[:, :GUARDED] >= 1).any(axis=(1, 2))))
        return max(counted, min(1.0, float(self.limit_chance[:GUARDED].sum())))

    @property
    def limit_chance(self) -> Array:
        """Chance that a quantity passes its limit (quantities, joints): a normal tail above the median."""
        middle, spread = self._middle()
        return np.asarray([[0.5 * erfc(z / sqrt(2)) for z in row] for row in ((1 - middle) / spread).tolist()])

    def share_at(self, deviations: float) -> Array:
        """Shares (quantities, joints) at so many deviations above the median."""
        middle, spread = self._middle()
        return np.asarray(middle + deviations * spread)

    @property
    def _origin(self) -> Array:
        origin = np.zeros_like(self.limits)
        origin[0] = origin[1] = self.rest
        return origin

    def _middle(self) -> tuple[Array, Array]:
        """Medians of the shares and the spread above them (quantities, joints): peaks are skewed towards the limit."""
        middle = np.median(self.shares, axis=0)
        above = np.maximum(self.shares - middle, 0.0)
        return middle, np.maximum(np.sqrt(2 * np.mean(above**2, axis=0)), _LEAST_SPREAD)

    def _simultaneous(self) -> float:
        middle, spread = self._middle()
        worst = ((self.shares - middle) / spread)[:, :GUARDED].max(axis=(1, 2))
        return float(np.quantile(worst, QUANTILE, method="higher"))


def predict(config: Config, plan: Plan, ensemble: Ensemble) -> Prediction:
    """Simulate `plan` on every arm of the ensemble."""
    segments = [_command(config, segment, plan.periods) for segment in plan.segments]
    feedback = feedback_of(config)
    pose = np.array(config.arm.rest_pose)
    samples = plan.segments[0].multisine.samples
    ramp = plan.segments[0].ramp_samples

    def one(arm: int) -> Peaks:
        physics, scale = ensemble.physics[arm], ensemble.torque_scale[arm]
        return _simulate(config, plan, physics, scale, segments, feedback, pose, (ramp, samples), arm < _SHOWN_ARMS)

    peaks = _each(one, ensemble.size)
    values = np.stack([peak.values for peak in peaks])
    limits = limits_of(config)
    rest = pose
    return Prediction(
        values,
        _shares(values, limits, rest),
        limits,
        np.array([peak.settled_after for peak in peaks]),
        np.stack([peak.position for peak in peaks if peak.position is not None]),
        rest,
        plan.rate,
    )


def limits_of(config: Config) -> Array:
    """(quantities, joints), in QUANTITIES and UNITS."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    velocity = np.array([joint.velocity_limit for joint in config.joints])
    current = np.array([joint.goal_limit for joint in config.joints])
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    torque = current * constant
    return np.stack((low, high, velocity, current, torque, torque * velocity))


def peaks_of(config: Config, position: Array, velocity: Array, current: Array) -> Array:
    """Extreme values (quantities, joints) of a motion (joints, samples) [rad, rad/s, A]; NaN are left out."""
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
    """As an arm feels it whose torque constants are `scale` (joints,) times what was believed."""
    return Feedback(feedback.stiffness * scale, feedback.damping * scale, feedback.pose, feedback.limit * scale)


def _command(config: Config, segment: Segment, periods: int) -> Array:
    """Torque of ramp in, settling and used periods, ramp out, in whole ticks of current (joints, samples) [N m]."""
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    tick = np.array(
        [abs(joint.joint.drive_unit(12.0 if joint.joint.mode is Mode.PWM else 0.0)) for joint in config.joints]
    )
    period = [segment.period_current] * (1 + periods)
    current = np.concatenate([segment.ramp_in, *period, segment.ramp_out])
    return np.ascontiguousarray((np.round(current / tick) * tick * constant).T)


def _simulate(
    config: Config,
    plan: Plan,
    physics: Physics,
    scale: Array,
    segments: list[Array],
    feedback: Feedback,
    pose: Array,
    sizes: tuple[int, int],
    keep: bool,
) -> Peaks:
    felt = scaled_feedback(feedback, scale)
    state = resting(pose)
    parts = []
    for command in segments:
        part = respond(physics, state, command * scale[:, None], plan.rate, felt)
        state = part.state
        parts.append(part)
    position = np.concatenate([part.position for part in parts], axis=1)
    velocity = np.concatenate([part.velocity for part in parts], axis=1)
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    current = np.concatenate([part.torque for part in parts], axis=1) / (scale * constant)[:, None]
    return Peaks(
        peaks_of(config, position, velocity, current),
        _settled_after(parts[0].position, sizes, plan.settle_within),
        position.astype(np.float32) if keep else None,
    )


def _settled_after(position: Array, sizes: tuple[int, int], within: float) -> int:
    ramp, samples = sizes
    periods = position[:, ramp:]
    for count in range(1, periods.shape[1] // samples):
        former, latest = (periods[:, (count - 1 + i) * samples : (count + i) * samples] for i in (0, 1))
        if settling_difference(former, latest) <= within:
            return count
    return 0


def _shares(values: Array, limits: Array, rest: Array) -> Array:
    shares = np.abs(values / limits)
    shares[:, 0] = (rest - values[:, 0]) / (rest - limits[0])
    shares[:, 1] = (values[:, 1] - rest) / (limits[1] - rest)
    return shares


def _each(work: Callable[[int], Peaks], count: int) -> list[Peaks]:
    """`work` for each arm; the compiled simulation lets go of the interpreter, so two threads share it."""
    with ThreadPoolExecutor(_THREADS) as threads:
        return list(threads.map(work, range(count)))
