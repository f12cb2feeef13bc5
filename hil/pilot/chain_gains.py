"""Gains of a spatial arm's software spring and damper, which hold it to its path: as high as the sample rate allows.

Both act on a state that is `DELAY_SAMPLES` old. The damper must be weak enough for the lightest joint not to oscillate.
A delayed spring drives the motion like a negative damper, so at a low rate the damping limits the stiffness.
"""

from dataclasses import dataclass

import numpy as np

from hil.config.schema import Config, StabiliserConfig
from hil.drivers.servo_prior import servo_prior
from hil.estimator.arrays import Array
from hil.estimator.chain.simulation.rollout import ChainArms, inertias
from hil.plan.gains import MOST_DAMPING, MOST_DRIVING, most_damping, most_stiffness
from hil.plan.stabiliser import DELAY_SAMPLES

FREQUENCY, DAMPING_RATIO = 3.0, 0.7
"""Natural frequency [Hz] and damping ratio that the stabiliser gives each joint, unless the sample rate is too low."""


@dataclass(frozen=True)
class ChainGains:
    """Limits on the gains of each joint (joints,).

    stiffness, damping: gains at a high rate [N m/rad, N m s/rad]. friction: smallest viscous friction of the ensemble
    [N m s/rad]. lightest: smallest inertia with the other joints free [kg m^2].
    """

    stiffness: Array
    damping: Array
    friction: Array
    lightest: Array

    @classmethod
    def of(cls, config: Config, arms: ChainArms, poses: Array) -> "ChainGains":
        """Compute limits that hold for all of these arms in all of these poses (poses, joints)."""
        held, free = inertias(arms, poses)
        middle, turn = np.median(held, axis=0), 2.0 * np.pi * FREQUENCY
        usual = [len(joint.ids) * servo_prior(joint.joint.servo).viscous.median for joint in config.joints]
        return cls(
            turn**2 * middle,
            2.0 * DAMPING_RATIO * turn * middle,
            np.minimum(usual, arms.drive[:, 0].min(axis=0)),
            np.maximum(free.min(axis=0), 0.0),
        )

    def at(self, rate: float) -> StabiliserConfig:
        return StabiliserConfig(stiffness=_rounded(self.stiffness_at(rate)), damping=_rounded(self._damping_at(rate)))

    def stiffness_at(self, rate: float) -> Array:
        """Stiffness of each joint (joints,) [N m/rad] at a sample rate [Hz], before rounding."""
        return np.minimum(self.stiffness, most_stiffness(rate, self._damping_at(rate), self.friction))

    def _damping_at(self, rate: float) -> Array:
        return np.minimum(self.damping, most_damping(rate, self.lightest))

    @property
    def sufficient_rate(self) -> float:
        """Lowest sample rate [Hz] at which no joint's spring is softened."""
        product = DELAY_SAMPLES * self.stiffness / MOST_DRIVING  # of rate and damping
        grown = MOST_DAMPING * np.maximum(self.lightest, 1e-12)  # damping per rate, up to `damping`
        root = np.sqrt(self.friction**2 + 4.0 * grown * product)
        slow, fast = (root - self.friction) / (2.0 * grown), product / (self.damping + self.friction)
        return float(np.where(grown * slow <= self.damping, slow, fast).max())


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values]
