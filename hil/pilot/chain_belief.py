"""Ensemble of spatial arms consistent with what is known about the real one, and its update with the recording of a
run.

Torque is linear in base parameters and friction, so each arm is updated by one randomised maximum a posteriori step (Y.
Chen and D. Oliver, Mathematical Geosciences 44 (2012) 1), with itself as the prior mean and independent noise added to
the recording. Parameters that a motion does not excite keep their spread.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.chain_prior import prior_arms
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.model.prior import spread_of
from hil.estimator.chain.simulation.rollout import ChainArms, inertias, is_physical
from hil.experiment.chain_watch import linear_parameters
from hil.pilot.belief import MOVED_STEPS
from hil.pilot.chain_gains import ChainGains
from hil.plan.chain_model import ChainTorque, known_chain, torque_limits
from hil.runs.recording import Phase

DRAWN = 400
TAUGHT_HZ = 25.0  # rows of the regression per second of recording
_CUT_OFF_TIMES = 6.0  # times the path's highest frequency
_WIDTH = 0.05  # rad/s
_LYING_RAD = 0.08
_NOISE_TIMES = 2.0  # residuals are not white
_LEAST_NOISE_SHARE = 0.005  # smallest noise, relative to a joint's largest torque
_MODEL_SPREAD = 0.01  # of each parameter of links and drives, for effects that the model does not include
_FEWEST_ROWS = 50
_PEAK, _BREAKAWAY = 0.99, 1.15
"""If a joint did not move, its dry friction is assumed to be at least `_BREAKAWAY` times the quantile `_PEAK` of its
torque.
"""
_LEAST_FRICTION_SHARE = 1e-4
_POSES = 12
_HALVINGS = 6
_LIGHTER, _LIGHTER_THAN_MEAN = 0.25, 0.5
"""The inertia of a joint must be at least the smaller of two values: the first fraction of its inertia in the lightest
arm of the prior, and the second fraction of its inertia in the arm with the fitted parameters.
"""

SIMULATED = 100
"""Largest number of arms that are simulated."""


@dataclass(frozen=True)
class ChainBelief:
    """An ensemble of arms; at most the first SIMULATED arms are simulated.

    lightest: smallest inertia of each joint with the others free, over all arms of the prior (joints,) [kg m^2].
    """

    config: Config
    arms: ChainArms
    lightest: Array

    @classmethod
    def prior(cls, config: Config) -> "ChainBelief":
        """Draw the ensemble before the first run. Raises ArmFileError."""
        arms = prior_arms(config, known_chain(config), DRAWN)
        return cls(config, arms, inertias(arms.first(SIMULATED), _poses(config))[1].min(axis=0))

    def at_least(self, count: int) -> ChainArms:
        """Return the first `count` arms of the ensemble. If it is a prior with fewer arms, further ones are drawn."""
        if count <= self.arms.size:
            return self.arms.first(count)
        return self.arms.and_more(prior_arms(self.config, known_chain(self.config), count - self.arms.size, seed=1))

    @property
    def torque(self) -> ChainTorque:
        """Inverse dynamics with the ensemble's mean parameters, in units of the commanded torque."""
        mean = linear_parameters(self.arms).mean(axis=0)
        count, n = self.arms.base.count, self.arms.drive.shape[2]
        return ChainTorque(self.arms.base, mean[:count], *mean[count:].reshape(3, n))

    def with_stabiliser(self, given: Config) -> Config:
        """Add stabiliser gains suited to the ensemble, unless the configuration has its own."""
        if given.stabiliser is not None:
            return given
        gains = self.gains(given).at(given.experiment.rate)
        return given.model_copy(update={"stabiliser": gains})

    def stiffness_share(self, given: Config) -> Array:
        """Stiffness of each joint's stabiliser at the configured sample rate, relative to its stiffness at a high rate
        (joints,); 1 if the configuration sets the gains.
        """
        if given.stabiliser is not None:
            return np.ones(len(given.joints))
        gains = self.gains(given)
        share: Array = gains.stiffness_at(given.experiment.rate) / gains.stiffness
        return share

    def gains(self, given: Config) -> ChainGains:
        """Limits on the stabiliser's gains for the ensemble."""
        return ChainGains.of(given, self.arms.first(SIMULATED), _poses(given))

    def learn(self, config: Config, samples: NDArray[np.void]) -> "ChainBelief":
        """Update the ensemble with a recording; return it unchanged if the recording is too short."""
        rows = _rows(self.arms, config, samples)
        if rows is None:
            return self
        Y, torque = rows
        drawn = linear_parameters(self.arms)
        count, everything = self.arms.base.count, self._links
        covariance = np.cov(drawn.T)
        covariance[:count, :count] += _MODEL_SPREAD**2 * everything @ everything.T
        covariance += np.diag(np.concatenate((np.zeros(count), _MODEL_SPREAD**2 * np.diag(covariance)[count:])))
        covariance += 1e-14 * np.eye(len(covariance))
        known = np.linalg.inv(covariance)
        mean = drawn.mean(axis=0)
        noise = _LEAST_NOISE_SHARE * torque_limits(config)
        for _ in range(3):  # estimate the noise from the residuals
            weight = (1.0 / noise**2)[:, None, None]
            spread = np.linalg.inv(known + np.einsum("jki,jkl->il", Y * weight, Y))
            fitted = mean + spread @ np.einsum("jki,jk->i", Y * weight, torque - Y @ mean)
            left = np.sqrt(np.mean((torque - Y @ fitted) ** 2, axis=1))
            noise = np.maximum(_NOISE_TIMES * left, _LEAST_NOISE_SHARE * torque_limits(config))
        random = np.random.default_rng(len(torque[0]))
        weight = (1.0 / noise**2)[:, None, None]
        moved = np.empty_like(drawn)
        for arm, each in enumerate(drawn):
            shaken = torque + noise[:, None] * random.standard_normal(torque.shape)
            moved[arm] = each + spread @ np.einsum("jki,jk->i", Y * weight, shaken - Y @ each)
        # Base parameters may be large and nearly cancel, so the parameters of the links are varied instead.
        moved[:, :count] += _MODEL_SPREAD * random.standard_normal((len(moved), everything.shape[1])) @ everything.T
        friction = _MODEL_SPREAD * np.abs(fitted[count:])
        moved[:, count:] += friction * random.standard_normal((len(moved), friction.size))
        dry = moved[:, count + len(torque) : count + 2 * len(torque)]
        np.maximum(dry, _BREAKAWAY * _withstood(config, samples, Y, torque, fitted), out=dry)
        return replace(self, arms=self._arms(moved))

    @property
    def _links(self) -> Array:
        """Derivatives of the base parameters with respect to the parameters of links and rotors, in units of their
        spread (base parameters, all).
        """
        described = known_chain(self.config).described.reshape(-1, TERMS)
        found: Array = self.arms.base.grouping * spread_of(described).reshape(-1)
        return found

    def _arms(self, linear: Array) -> ChainArms:
        """Arms with these parameters, in units of the commanded torque.

        Arms with an implausibly light joint are moved towards the mean, and discarded if that does not help.
        """
        base, drive = self.arms.base, self.arms.drive.copy()
        n = drive.shape[2]
        least = _LEAST_FRICTION_SHARE * torque_limits(self.config)
        mean = linear.mean(axis=0)
        good = self._plausible(linear, mean)
        for _ in range(_HALVINGS):
            if good.all():
                break
            linear = np.where(good[:, None], linear, 0.5 * (linear + mean))
            good = self._plausible(linear, mean)
        linear = linear[good] if good.any() else linear_parameters(self.arms)
        drive = drive[good] if good.any() else drive
        drive[:, :3] = linear[:, base.count :].reshape(-1, 3, n)
        drive[:, :2] = np.maximum(drive[:, :2], least)
        drive[:, 4] = 1.0
        return ChainArms(base, linear[:, : base.count].copy(), drive)

    def _plausible(self, linear: Array, mean: Array) -> Mask:
        """Whether arms with these parameters have a positive definite mass matrix and no joint that is too light."""
        count, poses = self.arms.base.count, _poses(self.config)

        def arms_of(parameters: Array) -> ChainArms:  # whose drives do not matter
            drives = np.broadcast_to(self.arms.drive[:1], (len(parameters), *self.arms.drive.shape[1:]))
            return ChainArms(self.arms.base, parameters[:, :count], drives)

        good: Mask = is_physical(arms_of(np.concatenate((mean[None], linear))), poses)
        lightest = _LIGHTER * self.lightest
        if good[0]:
            lightest = np.minimum(lightest, _LIGHTER_THAN_MEAN * inertias(arms_of(mean[None]), poses)[1][0])
        good = good[1:]
        good[good] = (inertias(arms_of(linear[good]), poses)[1] >= lightest).all(axis=1)
        return good


def _poses(config: Config) -> Array:
    """Poses within the limits, in which inertias are computed (poses, joints) [rad]."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    return np.random.default_rng(2).uniform(low, high, (_POSES, len(low)))


def _rows(arms: ChainArms, config: Config, samples: NDArray[np.void]) -> tuple[Array, Array] | None:
    """Regressor (joints, rows, parameters) and commanded torque (joints, rows) [N m] while the arm moves.

    Returns None if the recording is too short.
    """
    rate, n = config.experiment.rate, len(config.joints)
    phases = (Phase.RAMP_IN, Phase.PERIODIC, Phase.RAMP_OUT)
    rows = np.nonzero(np.isin(samples["phase"], phases) & (samples["segment"] == 0))[0]
    band = config.experiment.band
    highest = 1.0 if band is None else band[1]
    if rows.size < 2 * rate / highest:
        return None
    played = samples[rows[0] : rows[-1] + 1]
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    cut_off = min(_CUT_OFF_TIMES * highest, 0.2 * rate)
    from scipy.signal import butter, sosfiltfilt

    smooth = butter(4, cut_off, fs=rate, output="sos")
    position = sosfiltfilt(smooth, _filled(played["position"]), axis=0)
    goals: Array = played["goal_current"]
    torque = sosfiltfilt(smooth, goals * constants, axis=0)
    velocity = np.gradient(position, 1.0 / rate, axis=0)
    acceleration = np.gradient(velocity, 1.0 / rate, axis=0)
    is_free = np.abs(position - np.array(config.arm.rest_pose)).max(axis=1) > _LYING_RAD
    some = np.nonzero(is_free)[0][:: max(1, round(rate / TAUGHT_HZ))]
    if some.size < _FEWEST_ROWS:
        return None
    q, v, a = (np.ascontiguousarray(each[some].T) for each in (position, velocity, acceleration))
    rigid = arms.base.regressor(q, v, a)
    Y = np.zeros((n, some.size, rigid.shape[2] + 3 * n))
    Y[:, :, : rigid.shape[2]] = rigid
    for joint in range(n):
        at = rigid.shape[2] + joint
        Y[joint, :, at] = v[joint]
        Y[joint, :, at + n] = np.tanh(v[joint] / _WIDTH)
        Y[joint, :, at + 2 * n] = 1.0
    return Y, torque[some].T


def _withstood(config: Config, samples: NDArray[np.void], Y: Array, torque: Array, fitted: Array) -> Array:
    """Torque that failed to move each stationary joint in the last period (joints,) [N m]; 0 for joints that moved.

    Y, torque: as returned by `_rows`. fitted: parameters of the arm.
    """
    step = np.array([joint.joint.servo.position_unit for joint in config.joints])
    periodic = samples[samples["phase"] == Phase.PERIODIC]
    if not len(periodic):
        return np.zeros(len(step))
    last = periodic["period"] == periodic["period"][-1]
    stood = np.ptp(_filled(periodic["position"][last]), axis=0) <= MOVED_STEPS * step
    withstood: Array = np.quantile(np.abs(torque - Y @ fitted), _PEAK, axis=1)
    return np.where(stood, withstood, 0.0)


def _filled(position: Array) -> Array:
    filled = np.array(position, dtype=np.float64)
    at = np.arange(len(filled))
    for column in filled.T:
        missing = np.isnan(column)
        if missing.any() and not missing.all():
            column[missing] = np.interp(at[missing], at[~missing], column[~missing])
    return filled
