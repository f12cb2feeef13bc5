"""Settled motion of a fake arm without its bus: exact positions, to which errors and rounding can be added."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.spatial.remembered import remembered
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine, design_multisine, zippered_lines
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant

RATE = 400.0
PERIOD = 10.0
BAND = (0.1, 5.0)
STEP = 2.0 * math.pi / 4096  # rad
CURRENT_STEP = 2.69e-3  # A
COMMAND_TO_SAMPLE = 3e-4  # s
LINKS = (
    {"length": 0.147, "mass": 0.180, "centre": 0.081, "inertia": 7.0e-4},
    {"length": 0.180, "mass": 0.200, "centre": 0.112, "inertia": 2.9e-4},
)
DRIVES = (
    {"viscous": 0.045, "coulomb": 0.055, "offset": 0.004},
    {"viscous": 0.040, "coulomb": 0.050, "offset": -0.003},
)
SERVO = {"mass": 0.082, "rotor_inertia": 8.0e-8, "gear_ratio": 353.5, "torque_constant": 1.8}


@dataclass(frozen=True)
class Recorded:
    """One settled period."""

    torque: np.ndarray
    """Commanded torque, rounded to current steps (joints, samples) [N m]."""
    position: np.ndarray
    """Exact angles (joints, samples) [rad]."""
    start: np.ndarray
    """Angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    step: float = STEP

    def period(self, position: np.ndarray) -> SettledPeriod:
        """A period with these positions (joints, samples) [rad] as measurements."""
        steps = np.full(len(position), self.step)
        return SettledPeriod(RATE, self.torque, position, COMMAND_TO_SAMPLE, steps)

    def rounded(self) -> SettledPeriod:
        """The period as measured by an encoder."""
        return self.period(np.round(self.position / self.step) * self.step)


def servo_arm(friction: dict[str, Any], joints: int = 2, start: float = -math.pi / 2) -> Arm:
    """The arm of configs/fake_two_link.toml, or its first link, with this friction and drive.

    start: first angle of joint 1 [rad].
    """
    drives = [{**SERVO, **drive, **friction} for drive in DRIVES[:joints]]
    return Arm.model_validate({"start": (start, 0.0)[:joints], "links": LINKS[:joints], "drives": drives})


def wave(seed: int, peak: Sequence[float], period: float = PERIOD) -> Multisine:
    """A multisine with peaks `peak` (joints,) [N m]."""
    return design_multisine(RATE, period, zippered_lines(period, BAND, len(peak)), peak, seed)


@remembered
def record(arm: Arm, multisine: Multisine) -> Recorded:
    """Run the multisine: one period to settle, and one that is returned."""
    constant = np.array([drive.torque_constant for drive in arm.drives])[:, None]
    current = np.round(multisine.torque / constant / CURRENT_STEP) * CURRENT_STEP
    commands: list[Any] = current.T.tolist()
    plant = make_plant(arm)
    position = np.empty(current.shape)
    start = np.empty((2, len(current)))
    for turn in range(2):
        for k, command in enumerate(commands):
            t = (turn * multisine.samples + k) / RATE
            plant.advance(t + COMMAND_TO_SAMPLE, command)
            position[:, k] = plant.position
            if k == 0:
                start = np.array([plant.position, plant.velocity])
            plant.advance(t + 1.0 / RATE, command)
    return Recorded(current * constant, position, start)
