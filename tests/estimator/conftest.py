"""Settled periods of arms that the estimator does not know, recorded as a bus would: held and rounded."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from estimator.excitation import Multisine, design_multisine, zippered_lines
from estimator.period import SettledPeriod
from fakes.arm import Arm
from fakes.plant import make_plant

RATE = 400.0
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
IDEAL = {"coulomb_width": 0.05}
STICKING = {"current_lag": 1e-3, "stribeck_rise": 0.4, "stribeck_velocity": 0.15}

Recorder = Callable[[Arm, Multisine], SettledPeriod]


def servo_arm(joints: int, friction: dict[str, float]) -> Arm:
    drives = [{**SERVO, **drive, **friction} for drive in DRIVES[:joints]]
    return Arm.model_validate({"start": (-math.pi / 2, 0.0)[:joints], "links": LINKS[:joints], "drives": drives})


def record(arm: Arm, multisine: Multisine) -> SettledPeriod:
    """Run the arm for one period to settle and sample the next."""
    plant = make_plant(arm)
    constant = np.array([drive.torque_constant for drive in arm.drives])[:, None]
    current = np.round(multisine.torque / constant / CURRENT_STEP) * CURRENT_STEP
    commands: Sequence[Any] = current.T.tolist()
    samples = multisine.samples
    position = np.empty((2, len(arm.links), samples))
    for turn in range(2):
        for k, command in enumerate(commands):
            t = (turn * samples + k) / RATE
            plant.advance(t + COMMAND_TO_SAMPLE, command)
            position[turn, :, k] = plant.position
            plant.advance(t + 1.0 / RATE, command)
    rounded = np.round(position[1] / STEP) * STEP
    return SettledPeriod(RATE, current * constant, rounded, COMMAND_TO_SAMPLE, np.full(len(arm.links), STEP))


def multisine(seed: int, peak: Sequence[float], period: float = 10.0) -> Multisine:
    return design_multisine(RATE, period, zippered_lines(period, (0.1, 5.0), len(peak)), peak, seed)


@pytest.fixture(scope="session")
def ideal_arm() -> Arm:
    """Friction is what the estimator's plainest model has."""
    return servo_arm(2, IDEAL)


@pytest.fixture(scope="session")
def sticking_arm() -> Arm:
    """Friction sticks, rises at standstill, and the current lags."""
    return servo_arm(2, STICKING)


@pytest.fixture(scope="session")
def pendulum() -> Arm:
    return servo_arm(1, IDEAL)


@pytest.fixture(scope="session")
def recorded() -> Recorder:
    return record


@pytest.fixture(scope="session")
def wave() -> Callable[..., Multisine]:
    return multisine


@pytest.fixture(scope="session")
def ideal_period(ideal_arm: Arm) -> SettledPeriod:
    return record(ideal_arm, multisine(1, (0.8, 0.42)))


@pytest.fixture(scope="session")
def sticking_period(sticking_arm: Arm) -> SettledPeriod:
    return record(sticking_arm, multisine(1, (0.8, 0.42)))
