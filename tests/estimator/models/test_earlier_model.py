"""The mean residual of the last updates, against a direct calculation."""

import numpy as np
import pytest

from hil.estimator.models import earlier_model

# Compiling each function takes seconds.
add, describe, store, compare, keep, unexplained, forget = (
    getattr(function, "py_func", function)
    for function in (
        earlier_model.add,
        earlier_model.describe,
        earlier_model.store,
        earlier_model.compare,
        earlier_model.keep,
        earlier_model.unexplained,
        earlier_model.forget,
    )
)

COUNT, DT, FILTER_S = 3, 0.01, 0.02
THETA = np.array([0.5, -0.2, 0.1])
COVARIANCE = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.0], [0.0, 0.0, 0.01]])
NOISE, FRICTION, ROUNDING = 1e-3, 0.3, 2e-3


def played(updates: int, excess: float = 0.0, velocity: float = 1.0, stands: float = 0.0) -> np.ndarray:
    """Memory after two samples per update, whose torque exceeds that of the model by `excess` [N m] from half of the
    updates on.
    """
    past = earlier_model.memory(COUNT)
    for number in range(2 * updates):
        row = np.array([np.sin(number), np.cos(number), 1.0])
        for joint in (0, 1):
            further = excess if joint and number >= updates else 0.0
            add(past, joint, float(row @ THETA) + further, stands, velocity, row, DT)
            describe(past, joint, COUNT, NOISE, FRICTION)
        if number % 2:
            store(past, THETA, COVARIANCE)
    return past


def compared(past: np.ndarray, back: int, floor: float = 0.0, joint: int = 1) -> float:
    return compare(past, joint, back, COUNT, floor, ROUNDING, FILTER_S)


def limit(back: int, updates: int = 40, velocity: float = 1.0, stands: float = 0.0) -> float:
    """Mean residual torque that the earlier model just explains [N m]."""
    numbers = np.arange(2 * (updates - back) + 2, 2 * updates)  # from the sample after the moment compared with
    row = np.array([np.sin(numbers).mean(), np.cos(numbers).mean(), 1.0])
    seconds = DT * numbers.size
    variance = (
        row @ COVARIANCE @ row
        + ((earlier_model.RELATIVE_STD * row * THETA) ** 2).sum()
        + NOISE
        + 2.0 * ROUNDING * (FILTER_S / seconds) ** 2
    )
    held = max(stands, np.exp(-velocity * seconds / earlier_model.ELASTIC_RAD))
    return float(earlier_model.TIMES * np.sqrt(variance) + held * FRICTION)


@pytest.mark.parametrize("back", earlier_model.BACK)
@pytest.mark.parametrize(("velocity", "stands"), [(1.0, 0.0), (0.1, 0.0), (0.0, 0.0), (1.0, 0.7)])
def test_a_mean_counts_beyond_parameters_noise_and_friction(back: int, velocity: float, stands: float) -> None:
    most = limit(back, velocity=velocity, stands=stands)
    assert compared(played(40, 0.999 * most, velocity, stands), back) == 0.0
    assert compared(played(40, 1.001 * most, velocity, stands), back) == pytest.approx(1.001 * most)
    assert compared(played(40, -1.001 * most, velocity, stands), back) == pytest.approx(-1.001 * most)
    assert compared(played(40, 1.001 * most, velocity, stands), back, joint=0) == 0.0


def test_a_mean_below_the_floor_does_not_count() -> None:
    past = played(40, 3.0)
    assert compared(past, 5, floor=2.9) == pytest.approx(3.0)
    assert compared(past, 5, floor=3.1) == 0.0


def test_as_many_updates_as_are_compared_must_be_stored() -> None:
    assert compared(played(4, 5.0), 5) == 0.0
    past = played(12, 5.0)
    assert compared(past, 5) != 0.0
    forget(past)
    assert compared(past, 5) == 0.0


def test_a_mean_must_be_unexplained_in_successive_updates() -> None:
    past = earlier_model.memory(COUNT)
    for mean, found in ((0.4, 0.0), (0.0, 0.0), (0.4, 0.0), (-0.5, -0.5), (0.0, 0.0)):
        keep(past, 1, mean)
        assert unexplained(past, 1) == found
        assert unexplained(past, 0) == 0.0
