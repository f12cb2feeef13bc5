"""Supply sag under load: its detection from the servos' Present Input Voltage, and its effect on the torque.

A motor at velocity v draws a supply current with terms in u^2 and u v if it is driven with voltage u, or in i^2 and i v
if it is driven with current i. The resistance of the supply turns this current into a voltage drop. The register is
read only a few times a second, in steps of 0.1 V; a regression of its readings on these products gives the drop at
every sample.

A voltage-driven joint receives its duty cycle times the supply voltage at that moment, so its torque sags as well. A
current-driven joint is not affected as long as its servo can still drive the current.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask

FEWEST = 40
"""Minimum number of voltage readings."""
STEP_V = 0.1  # resolution of the register
SIGNIFICANT = 6.0
"""Number of standard errors by which the drop at full load must differ from zero."""
LEAST = {Mode.PWM: 0.005, Mode.CURRENT: 0.05}
"""Smallest drop that is reported, relative to the no-load voltage, by drive mode."""
_FULL_LOAD = 0.99  # quantile of the drop that counts as the drop at full load


@dataclass(frozen=True)
class Sag:
    """Sag of the supply voltage under load.

    volts: no-load voltage at each servo (joints,) [V]. by_square, by_product: drop per goal squared and per goal times
    velocity of each joint (joints,). worst: drop at full load [V]. Goals are in A, or in V under PWM.
    """

    volts: Array
    by_square: Array
    by_product: Array
    worst: float

    @property
    def share(self) -> float:
        """Drop at full load relative to the no-load voltage."""
        return self.worst / float(self.volts.min())

    def remaining(self, samples: NDArray[np.void]) -> Array:
        """Voltage relative to the no-load voltage (samples, joints)."""
        goal, velocity = samples["goal_current"], np.nan_to_num(samples["velocity"])
        drop = goal**2 @ self.by_square + (goal * velocity) @ self.by_product
        return np.asarray(1.0 - np.maximum(drop, 0.0)[:, None] / self.volts)


def supply_sag(config: Config, samples: NDArray[np.void]) -> Sag | None:
    """The drop in the supply voltage under load over a whole recording; None if it is too small to report."""
    goal, velocity, volts = samples["goal_current"], samples["velocity"], samples["supply_voltage"]
    joints = goal.shape[1]
    read = np.isfinite(volts) & np.isfinite(velocity).all(axis=1)[:, None]
    row, at = np.nonzero(read)
    if len(row) < FEWEST or len(set(at)) < joints:
        return None
    load = np.concatenate((goal[row] ** 2, goal[row] * velocity[row]), axis=1)
    size = np.sqrt(np.mean(load**2, axis=0))
    A = np.concatenate((np.eye(joints)[at], -load / np.maximum(size, 1e-12)), axis=1)
    measured = volts[row, at].astype(np.float64)
    solution = linalg.lstsq(A, measured, rcond=1e-9)[0]
    variance = max(float(np.mean((measured - A @ solution) ** 2)), STEP_V**2 / 12)
    covariance = variance * linalg.pinv(A.T @ A, hermitian=True)
    drop = -A[:, joints:] @ solution[joints:]
    full = int(np.argsort(drop)[round(_FULL_LOAD * (len(drop) - 1))])
    std = float(np.sqrt(A[full, joints:] @ covariance[joints:, joints:] @ A[full, joints:]))
    slopes = solution[joints:] / np.maximum(size, 1e-12)
    sag = Sag(solution[:joints], slopes[:joints], slopes[joints:], float(drop[full]))
    least = LEAST[Mode.PWM if by_voltage(config).any() else Mode.CURRENT]
    return sag if sag.worst > SIGNIFICANT * std and sag.share > least else None


def by_voltage(config: Config) -> Mask:
    """Whether each joint is driven by voltage (joints,)."""
    return np.array([joint.drive_mode is Mode.PWM for joint in config.joints])


def torque_factor(config: Config, sag: Sag | None, samples: NDArray[np.void]) -> Array:
    """Torque relative to the torque with a constant supply voltage (samples, joints)."""
    if sag is None:
        return np.ones(samples["goal_current"].shape)
    return np.where(by_voltage(config), sag.remaining(samples), 1.0)


def supply_notes(config: Config, sag: Sag | None) -> tuple[str, ...]:
    """Sentences about supply sag for the verdict; empty if the supply does not sag."""
    if sag is None:
        return ()
    found = f"The supply sags: its voltage falls by up to {sag.worst:.2g} V ({100 * sag.share:.2g} %) under load."
    if by_voltage(config).any():
        names = " and ".join(j.name for j, voltage in zip(config.joints, by_voltage(config), strict=True) if voltage)
        return (
            f"{found} The torque of {names} (driven by voltage) also falls; the estimate takes this into account. A "
            "stronger supply or a shorter, thicker cable helps.",
        )
    return (
        f"{found} The servos control their current, so this matters only at high speed: check whether the measured "
        "current follows its goal. A stronger supply or a shorter, thicker cable helps.",
    )
