"""Torque constants of a spatial arm from a known mass: a single fit to two settled periods, one of them with the mass.

A known mass on a link changes the base parameters by amounts known in kilograms and metres. In units of the first
joint's assumed torque constant, this change appears multiplied by the ratio of assumed to true constant, which is a
parameter of the fit (`ADDED_MASS`).
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.identify import ChainEstimate, identify_chain
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ADDED_MASS, ChainModel
from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError


@dataclass(frozen=True)
class MassOnLink:
    """A mass bolted to a link, compact enough that its inertia about its centre of mass is practically isotropic."""

    mass: float
    """Mass [kg]."""
    at: tuple[float, float, float]
    """Position of its centre of mass in the link's frame [m]."""
    link: int
    """Index of the joint that moves the link, from 0."""
    inertia: float = 0.0
    """Inertia about its centre of mass [kg m^2]."""

    def added(self, base: BaseParameters) -> Array:
        """Return the change in the base parameters (base parameters,) [SI]; raises ModelError for impossible values."""
        if not (self.mass > 0.0 and self.inertia >= 0.0 and 0 <= self.link < base.chain.joints):
            raise ModelError(
                f"a mass of {self.mass:g} kg with inertia {self.inertia:g} kg m^2 on link {self.link + 1} of "
                f"{base.chain.joints}: the mass must be positive, the inertia non-negative, and the link must exist"
            )
        c = np.array(self.at)
        about = self.mass * (c @ c * np.eye(3) - np.outer(c, c)) + self.inertia * np.eye(3)
        every = np.zeros(TERMS * base.chain.joints)
        first = TERMS * self.link
        every[first : first + 10] = [self.mass, *(self.mass * c), *about[np.triu_indices(3)]]
        return base.of_all(every)


@dataclass(frozen=True)
class ChainCalibration:
    """Torque constants, and the arm's parameters scaled to them."""

    factor: Array
    """Ratio of true to assumed torque constant of each joint (joints,)."""
    factor_std: Array
    estimate: ChainEstimate
    """The fit, whose values are in units of the first joint's assumed torque constant."""
    value: Array
    """Values of `ChainModel.linear_names` for the arm without the mass, scaled to the identified torque constants [SI].
    """
    std: Array
    residual_steps: Array
    """RMS of the residual in encoder steps (runs, joints)."""
    noise_steps: Array
    """Noise of one sample of each angle in each run, encoder rounding included (runs, joints) [encoder steps]."""

    @property
    def misfit(self) -> float:
        """Mean square of both runs' residuals, each relative to its run's noise; 1 for noise alone."""
        return float(np.mean((self.residual_steps / self.noise_steps) ** 2))


def calibrate_chain(
    without: SettledPeriod, with_mass: SettledPeriod, model: ChainModel, prior: Prior, mass: MassOnLink
) -> ChainCalibration:
    """Estimate the torque constants of all joints from two settled periods.

    model: a model with `added_mass` and, for several joints, `torque_scale`. prior: a prior that contains nothing about
    the torque constants. Raises ModelError, ConvergenceError.
    """
    if not model.added_mass or model.torque_scale == (model.joints == 1):
        raise ModelError("a calibration needs a model with added_mass and, for several joints, torque_scale")
    added = mass.added(model.base)
    if not np.any(np.abs(added) > 1e-9):
        raise ModelError("the added mass has no effect on the joint torques: it lies on the first joint's axis")
    estimate = identify_chain((without, with_mass), model, prior, (None, added))
    names, value = estimate.names, estimate.value
    index = {name: i for i, name in enumerate(names)}
    scale = value[index[ADDED_MASS]]
    linear = len(model.linear_names)
    # Logarithms of the factors: that of a joint's torque scale minus that of the added mass.
    to_log = np.zeros((model.joints, len(names)))
    factor = np.full(model.joints, 1.0 / scale)
    to_log[:, index[ADDED_MASS]] = -1.0 / scale
    for joint in range(1, model.joints):
        at = index[f"torque_scale_{joint + 1}"]
        factor[joint] *= value[at]
        to_log[joint, at] = 1.0 / value[at]
    true_units = np.eye(linear, len(names)) / scale
    true_units[:, index[ADDED_MASS]] = -value[:linear] / scale**2
    return ChainCalibration(
        factor,
        factor * _std(to_log, estimate.covariance),
        estimate,
        value[:linear] / scale,
        _std(true_units, estimate.covariance),
        np.stack(
            [
                _rms(period.position - position, period) / period.position_step
                for period, position in zip((without, with_mass), estimate.positions, strict=True)
            ]
        ),
        np.stack([period.noise / period.position_step for period in (without, with_mass)]),
    )


def _std(rows: Array, covariance: Array) -> Array:
    """Standard errors of linear combinations; infinite for those that include an undetermined parameter."""
    known = np.isfinite(np.diag(covariance))
    variance = np.einsum("ij,jk,ik->i", rows[:, known], covariance[np.ix_(known, known)], rows[:, known])
    unknown = np.any(rows[:, ~known] != 0.0, axis=1)
    return np.where(unknown, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _rms(residual: Array, period: SettledPeriod) -> Array:
    rms: Array = np.sqrt(np.nanmean(np.square(np.where(period.valid, residual, np.nan)), axis=1))
    return rms
