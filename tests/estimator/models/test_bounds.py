"""Parameters at a bound: named if the data push them against it and others depend on them."""

import numpy as np
import pytest

from hil.estimator.arrays import Array
from hil.estimator.models.bounds import beyond_range, bound_sentence, matters, step_beyond
from hil.estimator.simulation.back_emf import limited

NAMES = ("inertia_1", "viscous_1", "load_1")


def pressed(truth: float, seed: int) -> tuple[Array, Array, Array]:
    """Fit two positive parameters and one that ends at zero, whose true value is `truth`."""
    rng = np.random.default_rng(seed)
    Y = rng.standard_normal((400, 3))
    Y[:, 2] += 0.7 * Y[:, 1]
    measured = Y @ (1.0, 2.0, truth) + 0.01 * rng.standard_normal(400)
    value = np.array([*np.linalg.lstsq(Y[:, :2], measured, rcond=None)[0], 1e-9])
    slopes = np.diag(value)  # logarithmic coordinates
    jacobian, residual = Y @ slopes / 0.01, (Y @ value - measured) / 0.01
    step, std = step_beyond(jacobian.T @ jacobian, jacobian.T @ residual, slopes)
    return beyond_range(value, step, std, np.zeros(3), np.full(3, np.inf)), step, std


@pytest.mark.parametrize("seed", range(3))
def test_only_what_the_data_press_against_zero_is_found(seed: int) -> None:
    beyond, step, std = pressed(-0.02, seed)
    assert beyond.tolist() == [False, False, True]
    assert matters(NAMES, beyond, step, std)
    assert not matters(NAMES, beyond, step, 1e9 * std)
    assert matters(NAMES, beyond[[0, 2, 1]], step, 1e9 * std), "viscous friction itself"
    beyond, _, _ = pressed(0.0, seed)
    assert not beyond.any()


def test_a_joint_that_loses_too_much_inertia_is_found() -> None:
    arm = {"inertia_1": 1e-3, "viscous_1": 0.2, "back_emf_1": 0.9, "lag": 1e-3}
    assert limited(arm) == ()
    assert limited(arm | {"lag": 5e-3}) == ("back_emf_1",)
    assert "check the joint's mode" in bound_sentence(limited(arm | {"lag": 5e-3}))
