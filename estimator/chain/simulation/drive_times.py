"""Delays and lags of a chain's motors, joint by joint."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.chain.model.chain_model import LAG_DIFFERENCE
from hil.estimator.simulation.drive import torque_and_slopes

LEAST_LAG = 1e-4  # s: a joint whose difference would make its lag smaller has a negative delay in addition


@dataclass(frozen=True)
class DriveTimes:
    """Delays and time constants of the first-order lags of all joints' torques, each (joints,) [s].

    by_delay: whether a change of the joint's difference from the first joint changes its delay, rather than its lag.
    """

    delay: Array
    lag: Array
    by_delay: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, parameters: Mapping[str, float], joints: int) -> "DriveTimes":
        """Take them from parameters by name [SI]; a drive without a lag has different delays."""
        delay, lag = parameters.get("delay", 0.0), parameters.get("lag", 0.0)
        beyond = np.array([parameters.get(f"{LAG_DIFFERENCE}_{joint + 1}", 0.0) for joint in range(joints)])
        if "lag" not in parameters:
            return cls(delay + beyond, np.zeros(joints), np.full(joints, True))
        short = (beyond != 0.0) & (lag + beyond < LEAST_LAG)
        lags = np.where(short, LEAST_LAG, lag + beyond)
        return cls(delay + np.where(short, lag + beyond - LEAST_LAG, 0.0), lags, short)

    @property
    def total(self) -> Array:
        """How much later than its command each joint's torque is (joints,) [s]."""
        total: Array = np.maximum(self.lag + self.delay, 0.0)
        return total

    def torque(self, command: Array, rate: float, command_to_sample: float, steps: int) -> tuple[Array, Array]:
        """Return the motors' torques and their derivatives by delay and by the joint's difference; see
        `torque_and_slopes`.
        """
        if np.all(self.delay == self.delay[0]):
            delay = float(self.delay[0])
            torque, slopes = torque_and_slopes(command, rate, command_to_sample, steps, delay=delay, lag=self.lag)
        else:
            each = [
                torque_and_slopes(row[None], rate, command_to_sample, steps, delay=float(delay), lag=float(lag))
                for row, delay, lag in zip(command, self.delay, self.lag, strict=True)
            ]
            torque = np.concatenate([one for one, _ in each])
            slopes = np.concatenate([by for _, by in each], axis=1)
        slopes[1, self.by_delay] = slopes[0, self.by_delay]
        return torque, slopes
