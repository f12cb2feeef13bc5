"""Settled periods of arms simulated independently of the estimator, with held commands and rounded positions."""

from collections.abc import Callable

import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine
from hil.fakes.plants.arm import Arm
from tests.support import recorded_arm
from tests.support.recorded_arm import servo_arm

IDEAL = {"coulomb_width": 0.05}
STICKING = {"current_lag": 1e-3, "stribeck_rise": 0.4, "stribeck_velocity": 0.15}

Recorder = Callable[[Arm, Multisine], SettledPeriod]


def recorded_period(arm: Arm, multisine: Multisine) -> SettledPeriod:
    """Return one settled period, rounded by the encoder."""
    return recorded_arm.record(arm, multisine).rounded()


@pytest.fixture(scope="session")
def ideal_arm() -> Arm:
    """Return a period of an arm with the friction of the estimator's simplest model."""
    return servo_arm(IDEAL)


@pytest.fixture(scope="session")
def sticking_arm() -> Arm:
    """Return a period of an arm with stiction, Stribeck friction and a lagging current."""
    return servo_arm(STICKING)


@pytest.fixture(scope="session")
def pendulum() -> Arm:
    return servo_arm(IDEAL, joints=1)


@pytest.fixture(scope="session")
def recorded() -> Recorder:
    return recorded_period


@pytest.fixture(scope="session")
def wave() -> Callable[..., Multisine]:
    return recorded_arm.wave


@pytest.fixture(scope="session")
def ideal_period(ideal_arm: Arm) -> SettledPeriod:
    return recorded_period(ideal_arm, recorded_arm.wave(1, (0.8, 0.42)))


@pytest.fixture(scope="session")
def sticking_period(sticking_arm: Arm) -> SettledPeriod:
    return recorded_period(sticking_arm, recorded_arm.wave(1, (0.8, 0.42)))
