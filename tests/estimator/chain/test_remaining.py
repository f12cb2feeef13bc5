"""How far a fit has stopped from its minimum."""

import numpy as np
import pytest

from hil.estimator.chain.fit.stage2 import _remaining
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic


def stopped_at(step: np.ndarray, normal: np.ndarray) -> Minimum:
    """A fit that stopped `step` before the minimum of a sum of squares with these normal equations."""
    return Minimum(np.zeros(len(step)), Quadratic(1.0, normal, -normal @ step), 1)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_the_step_to_the_minimum_and_its_decrease_are_those_of_the_normal_equations(scale: float) -> None:
    slopes = np.random.default_rng(1).standard_normal((20, 4)) * np.array([1.0, scale, 1.0, 10.0])
    normal, missing = slopes.T @ slopes, np.array([0.3, -1.0 / scale, 0.0, 2.0])
    step, decrease = _remaining(stopped_at(missing, normal))
    np.testing.assert_allclose(step, missing, rtol=1e-7, atol=1e-9)
    assert decrease == pytest.approx(missing @ normal @ missing)


def test_nothing_remains_at_a_minimum_nor_in_a_direction_without_information() -> None:
    normal = np.diag([4.0, 0.0])
    step, decrease = _remaining(stopped_at(np.array([0.0, 5.0]), normal))
    assert decrease == 0.0 and step[0] == 0.0
