"""A fit whose data ask for a value beyond its range says so, however far the coordinate has run."""

from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from tests.support import recorded_arm

MODEL = Model(1, "coulomb", "lag")


@pytest.fixture(scope="module")
def period() -> recorded_arm.SettledPeriod:
    return _recorded(0.8)


@pytest.fixture(scope="module")
def calm_period() -> recorded_arm.SettledPeriod:
    """A period in which the arm does not turn over: without damping, its motion would be chaotic otherwise."""
    return _recorded(0.15)


def _recorded(torque: float) -> recorded_arm.SettledPeriod:
    arm = recorded_arm.servo_arm({"coulomb_width": 0.05}, joints=1)
    return recorded_arm.record(arm, recorded_arm.wave(1, (torque,))).rounded()


@pytest.mark.parametrize("shift_s", [-5e-5, -1e-3])
def test_a_lag_that_would_have_to_be_negative_is_at_its_bound(
    period: recorded_arm.SettledPeriod, shift_s: float
) -> None:
    early = replace(period, command_to_sample=period.command_to_sample + shift_s)
    found = identify(early, MODEL)
    assert found.parameters["lag"] < 1e-6
    assert found.at_bound == ("lag",)


@pytest.mark.parametrize("driven_by", [0.05, 0.06, 0.07])
def test_viscous_friction_that_would_have_to_be_negative_is_at_its_bound(
    calm_period: recorded_arm.SettledPeriod, driven_by: float
) -> None:
    velocity = np.gradient(calm_period.position, 1.0 / calm_period.rate, axis=1)
    driven = replace(calm_period, torque=calm_period.torque - driven_by * velocity)
    assert "viscous_1" in identify(driven, MODEL).at_bound


def test_nothing_is_at_a_bound_where_the_model_is_right(period: recorded_arm.SettledPeriod) -> None:
    assert identify(period, MODEL).at_bound == ()
