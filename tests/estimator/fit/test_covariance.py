"""Covariance of the parameters from that of their coordinates, with coordinates that have no effect."""

import numpy as np
import pytest

from hil.estimator.arrays import Mask
from hil.estimator.fit.covariance import by_parameters

NO_EFFECT = np.diag([1e-4, np.inf])


def test_a_width_at_its_floor_is_zero_to_within_its_own_value() -> None:
    slopes, value = np.diag([2.0, 1e-9]), np.array([0.1, 3e-4])
    found = by_parameters(NO_EFFECT, slopes, value, np.array([False, True]))
    assert np.sqrt(np.diag(found)) == pytest.approx([0.02, 3e-4])


@pytest.mark.parametrize("floored", [None, np.array([False, False])])
def test_a_large_value_without_effect_is_not_determined(floored: Mask | None) -> None:
    """The slope of a number of ripple cycles is its scale, far below its value, but it has no floor."""
    slopes, value = np.diag([2.0, 0.02]), np.array([0.1, 40.0])
    found = by_parameters(NO_EFFECT, slopes, value, floored)
    assert np.isinf(found[1, 1]) and found[0, 0] == pytest.approx(4e-4)
