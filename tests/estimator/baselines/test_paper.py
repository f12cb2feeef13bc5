"""The seed paper's method: the printed version, the corrected one, and the difference between them."""

import numpy as np
import pytest

from benchmarks.seed_paper.equations import (
    PaperArm,
    coefficients,
    fit_as_printed,
    fit_likelihood,
    own_lines,
    printed_lines,
    record,
    response,
)
from hil.estimator.errors import ModelError, ShapeError

GUESS = PaperArm(mass_1=3.5, mass_2=1.0, viscous=2.0)


def test_without_noise_both_methods_are_exact() -> None:
    arm, excitation = PaperArm(), own_lines()
    lines = response(arm, excitation, 1)
    assert fit_as_printed(lines, excitation, arm) == pytest.approx((5.0, 1.5), rel=1e-6)
    found = fit_likelihood(lines, excitation, GUESS, 1)
    assert (found.mass_1, found.mass_2) == pytest.approx((5.0, 1.5), rel=1e-6)


def test_with_the_papers_noise_the_print_is_biased_and_the_likelihood_is_not() -> None:
    arm, excitation = PaperArm(), own_lines()
    literal, likely, std = [], [], []
    for seed in range(40):
        lines = coefficients(record(arm, excitation, 1, 100.0, seed), excitation)
        literal.append(fit_as_printed(lines, excitation, arm))
        found = fit_likelihood(lines, excitation, GUESS, 1)
        likely.append((found.mass_1, found.mass_2))
        std.append(found.std)
    rmse = np.sqrt(np.mean((np.array(likely) - (5.0, 1.5)) ** 2, axis=0))
    assert rmse[0] <= 0.05 and rmse[1] <= 0.004
    assert np.mean(std, axis=0) == pytest.approx(rmse, rel=0.35)
    assert np.mean([m2 for _, m2 in literal]) < 0.5, "errors in variables bias m2 towards zero"


def test_the_corrected_arm_is_second_order_and_its_friction_is_found() -> None:
    arm, excitation = PaperArm(viscous=4.0), own_lines()
    lines = coefficients(record(arm, excitation, 2, 100.0, 1), excitation)
    found = fit_likelihood(lines, excitation, GUESS, 2)
    assert found.mass_1 == pytest.approx(5.0, abs=4 * found.std[0])
    assert found.mass_2 == pytest.approx(1.5, abs=4 * found.std[1])
    assert found.viscous == pytest.approx(4.0, rel=0.02)


def test_the_same_lines_on_both_joints_are_refused() -> None:
    arm, excitation = PaperArm(), printed_lines()
    with pytest.raises(ModelError, match="33"):
        fit_as_printed(response(arm, excitation, 1), excitation, arm)


def test_a_period_too_short_for_the_lines_is_refused() -> None:
    with pytest.raises(ShapeError, match="more than 86 samples"):
        coefficients(np.zeros((2, 50)), own_lines())


def test_undamped_poles_are_imaginary_so_that_nothing_settles() -> None:
    """The paper claims exponential convergence, but the poles of its own arm have no real part (docs/paper.md)."""
    arm = PaperArm()
    squared = np.linalg.eigvals(-np.linalg.inv(arm.mass_matrix()) @ arm.stiffness())
    assert np.all(squared.real < 0.0) and np.abs(squared.imag).max() < 1e-12
