"""Friction terms that the speeds of a motion cannot separate: the fit does not mix them, and their errors say so."""

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.covariance import robust_covariance
from hil.estimator.fit.levenberg_marquardt import Quadratic
from hil.estimator.fit.reparametrisation import Coordinates, highest_values
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.options import CoordinateOptions
from tests.support import recorded_arm

NAMES = ("coulomb_1", "coulomb_width_1", "stribeck_rise_1", "stribeck_velocity_1")
TOP_SPEED = 4.0
COORDINATES = Coordinates(
    NAMES,
    np.array([0.1, 0.05, 1.0, 1.0]),
    CoordinateOptions(1e-4),
    highest=highest_values(NAMES, np.array([TOP_SPEED])),
)


def test_no_step_takes_a_speed_far_beyond_those_of_the_motion() -> None:
    x = COORDINATES.coordinates(np.array([0.1, 0.01, 0.3, 100.0]))
    assert COORDINATES.values(x)[3] == pytest.approx(3.0 * TOP_SPEED)
    x = COORDINATES.coordinates(np.array([0.1, 0.01, 0.3, 0.2]))
    for _ in range(12):
        least, most = np.full(4, -2.0), np.full(4, 2.0)
        COORDINATES.limit(x, least, most, max_relative_decrease=0.5)
        x = COORDINATES.moved(x, most)
    assert COORDINATES.values(x)[[1, 3]] == pytest.approx([0.3 * TOP_SPEED, 3.0 * TOP_SPEED])


def test_a_rise_that_never_falls_becomes_coulomb_friction() -> None:
    x = np.concatenate((COORDINATES.coordinates(np.array([0.005, 0.01, 7.2, 11.0])), [0.7]))
    plain = COORDINATES.undisguised(x)
    coulomb, width, rise, velocity = COORDINATES.values(plain[:4])
    assert coulomb == pytest.approx(0.041, rel=0.05)
    assert width == pytest.approx(0.01) and rise < 0.1 and velocity < 0.5 and plain[4] == 0.7
    real = COORDINATES.coordinates(np.array([0.1, 0.01, 0.5, 0.9 * TOP_SPEED]))
    assert np.array_equal(COORDINATES.undisguised(real), real)


def test_a_coulomb_step_that_no_speed_completes_becomes_viscous_friction() -> None:
    """Recordings of arms without dry friction determined neither."""
    names = ("viscous_1", "coulomb_1", "coulomb_width_1")
    coordinates = Coordinates(names, np.array([0.1, 0.1, 0.05]), CoordinateOptions(1e-4))
    x = np.concatenate((coordinates.coordinates(np.array([0.02, 3.0, 1000.0])), [0.7]))
    sharp = coordinates.without_wide_steps(x, np.array([TOP_SPEED]))
    viscous, coulomb, width = coordinates.values(sharp[:3])
    assert viscous == pytest.approx(0.023) and coulomb < 1e-3 and width < 0.1 and sharp[3] == 0.7
    narrow = coordinates.coordinates(np.array([0.02, 0.1, 0.25 * TOP_SPEED]))
    assert np.array_equal(coordinates.without_wide_steps(narrow, np.array([TOP_SPEED])), narrow)


def test_a_rise_above_no_friction_stays_bounded() -> None:
    x = COORDINATES.coordinates(np.array([1e-9, 0.01, 1e7, 0.2]))
    for _ in range(12):
        least, most = np.full(4, -2.0), np.full(4, 2.0)
        COORDINATES.limit(x, least, most, max_relative_decrease=0.5)
        x = COORDINATES.moved(x, most)
        assert COORDINATES.values(x)[2] == pytest.approx(10.0)


def test_what_only_their_sum_determines_has_no_small_standard_error() -> None:
    together = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1e-9], [0.0, 0.0, 1.0]])
    together[2, 1] = together[1, 2]
    covariance = robust_covariance(Quadratic(1000.0, 1e6 * together, np.zeros(3)), None, 1000, 3)
    alone = 1e-3
    assert np.sqrt(np.diag(covariance))[2] == pytest.approx(alone, rel=0.1)
    assert (np.sqrt(np.diag(covariance))[:2] > 1e5 * alone).all()


@pytest.fixture(scope="module")
def recorded() -> tuple[SettledPeriod, Estimate]:
    """A period of an arm without Stribeck friction, and its fit by a model without it."""
    arm = recorded_arm.servo_arm({"coulomb_width": 0.05}, joints=1)
    period = recorded_arm.record(arm, recorded_arm.wave(1, (0.8,))).rounded()
    return period, identify(period, Model(1, "coulomb", "lag"))


def test_a_fit_leaves_a_stribeck_term_that_has_taken_over_coulomb_friction(
    recorded: tuple[SettledPeriod, Estimate],
) -> None:
    period, plain = recorded
    known = plain.parameters
    disguised = known | {
        "coulomb_1": known["coulomb_1"] / 81.0,
        "stribeck_rise_1": 80.0,
        "stribeck_velocity_1": 100.0,
    }
    found = identify(period, Model(1, "stribeck", "lag"), near=Near(disguised, plain.start))
    name = found.names.index("coulomb_1")
    assert found.value[name] == pytest.approx(known["coulomb_1"], abs=4.0 * found.std[name])
    assert found.std[name] < 0.1 * known["coulomb_1"]
