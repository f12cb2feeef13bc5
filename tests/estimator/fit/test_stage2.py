"""Steps of the likelihood's fit: widths of friction, limits, parallel candidates."""

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.levenberg_marquardt import Quadratic, minimise
from hil.estimator.fit.reparametrisation import Coordinates
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.options import CoordinateOptions, LikelihoodOptions

FLOOR = 1e-4
NAMES = ("inertia_1", "coulomb_width_1", "stribeck_rise_1", "offset_1")


def shaped(width: float) -> tuple[Coordinates, np.ndarray]:
    coordinates = Coordinates(NAMES, np.array([0.02, 0.05, 1.0, 0.5]), CoordinateOptions(FLOOR))
    return coordinates, coordinates.coordinates(np.array([0.02, width, 0.3, -0.01]))


def test_a_width_changes_as_a_linear_model_foresees() -> None:
    coordinates, x = shaped(0.01)
    step = np.array([0.1, -0.4, 0.2, 0.3])
    foreseen = coordinates.values(x) + coordinates.slopes(x) @ step
    moved = coordinates.values(coordinates.moved(x, step))
    assert moved[1] == pytest.approx(foreseen[1], rel=1e-12)
    assert coordinates.moved(x, step)[[0, 2, 3]] == pytest.approx((x + step)[[0, 2, 3]])


def test_a_width_comes_to_its_floor_and_back() -> None:
    coordinates, x = shaped(0.003)
    for way in (-1.0, 1.0):
        for _ in range(8):
            least, most = np.full(4, -2.0), np.full(4, 2.0)
            coordinates.limit(x, least, most, max_relative_decrease=0.5)
            x = coordinates.moved(x, least if way < 0.0 else np.where([False, True, False, False], most, 0.0))
        width = coordinates.values(x)[1]
        assert FLOOR < width < 1.01 * FLOOR if way < 0.0 else width > 0.1


def test_no_step_of_a_minimum_is_longer_than_its_limits() -> None:
    goal = np.array([5.0, -7.0, 3.0])
    seen: list[np.ndarray] = []

    def evaluate(x: np.ndarray) -> Quadratic:
        seen.append(x)
        return Quadratic(float((x - goal) @ (x - goal)), np.eye(3), x - goal)

    limits = np.array([-1.0, -1.0, 0.0]), np.array([0.5, 1.0, 0.0])
    found = minimise(evaluate, np.zeros(3), 1e-9, limits=lambda _: limits)
    steps = np.diff(np.array(seen), axis=0)
    assert (steps >= limits[0]).all() and (steps <= limits[1]).all()
    assert found.x == pytest.approx([5.0, -7.0, 0.0], abs=1e-3)


def test_tries_side_by_side_give_what_they_give_one_after_the_other(sticking_period: SettledPeriod) -> None:
    model = Model(2, "stribeck", "lag")
    at_once = identify(sticking_period, model)
    one_by_one = identify(sticking_period, model, options=LikelihoodOptions(threads=1))
    assert np.array_equal(at_once.value, one_by_one.value)
    assert np.array_equal(at_once.covariance, one_by_one.covariance)
    assert at_once.iterations == one_by_one.iterations
