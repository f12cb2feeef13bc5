"""The bounded step minimises the quadratic function within its bounds."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from hil.estimator.fit.bounded_step import bounded_step
from hil.estimator.fit.levenberg_marquardt import Quadratic, minimise


def value(matrix: np.ndarray, slope: np.ndarray, step: np.ndarray) -> float:
    return float(step @ matrix @ step / 2 + slope @ step)


@example(9314195, 2, 3.138671875)  # a bound that is reached with a rounding error
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.floats(0.0, 5.0))
@settings(max_examples=100, deadline=None)
def test_matches_scipy_within_bounds_even_in_narrow_valleys(seed: int, size: int, decades: float) -> None:
    random = np.random.default_rng(seed)
    axes = np.linalg.qr(random.standard_normal((size, size)))[0]
    root = axes * np.sqrt(np.logspace(0.0, -decades, size))
    matrix, slope = root @ root.T, random.standard_normal(size)
    bound = random.uniform(0.05, 2.0, size)
    step = bounded_step(matrix, slope, -bound, bound)
    reference = lsq_linear(root.T, -np.linalg.solve(root, slope), (-bound, bound), "bvls", tol=1e-14).x
    assert np.all(np.abs(step) <= bound)
    best = value(matrix, slope, reference)
    assert value(matrix, slope, step) <= best + 1e-6 * abs(best)


def test_a_step_without_active_bounds_is_newtons() -> None:
    matrix, slope = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([0.1, -0.2])
    assert np.allclose(bounded_step(matrix, slope, -np.ones(2), np.ones(2)), -np.linalg.solve(matrix, slope))


def test_fixed_coordinates_stay() -> None:
    matrix, slope = np.array([[2.0, 0.9], [0.9, 1.0]]), np.array([3.0, -4.0])
    step = bounded_step(matrix, slope, np.array([0.0, -9.0]), np.array([0.0, 9.0]))
    assert step.tolist() == [0.0, 4.0]


def test_a_narrow_valley_is_followed_to_its_end_with_short_steps() -> None:
    """Three nearly dependent coordinates: the minimum is a hundred longest steps away along the valley."""
    J = np.array([[1.0, 1.0, 1.0], [0.0, 0.03, -0.02], [1e-2, -2e-2, 1e-2]])
    goal = np.array([90.0, -40.0, -60.0])

    def evaluate(x: np.ndarray) -> Quadratic:
        r = J @ (x - goal)
        return Quadratic(float(r @ r) + 1e-3, J.T @ J, J.T @ r)

    assert np.allclose(minimise(evaluate, np.zeros(3), 1e-9, 1e-9).x, goal, atol=0.05)


def test_a_search_ends_where_the_sum_alone_promises_what_the_normal_equations_do_not_confirm() -> None:
    evaluated = []

    def evaluate(x: np.ndarray) -> Quadratic:
        evaluated.append(x)
        return Quadratic(1.0 + 1e-3 * len(evaluated), np.eye(2), np.array([0.3, -0.2]))

    found = minimise(evaluate, np.zeros(2), 1e-6, cost=lambda x: 0.9 - 0.1 * float(x @ x))
    assert found.x.tolist() == [0.0, 0.0] and len(evaluated) < 50
