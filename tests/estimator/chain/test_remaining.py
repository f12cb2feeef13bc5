"""How far a fit has stopped from its minimum, and what follows from it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain import identify
from hil.estimator.chain.fit import stage2
from hil.estimator.chain.fit.coordinates import ChainCoordinates
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.options import ChainOptions
from hil.estimator.chain.fit.remaining import remaining
from hil.estimator.chain.identify import ChainEstimate, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic

FREE = ChainCoordinates(("moment_x_1",), np.ones(1), np.zeros(0))


def stopped_at(step: np.ndarray, normal: np.ndarray) -> Minimum:
    """A fit that stopped `step` before the minimum of a sum of squares with these normal equations."""
    return Minimum(np.zeros(len(step)), Quadratic(1.0, normal, -normal @ step), 1)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_the_step_to_the_minimum_and_its_decrease_are_those_of_the_normal_equations(scale: float) -> None:
    slopes = np.random.default_rng(1).standard_normal((20, 4)) * np.array([1.0, scale, 1.0, 10.0])
    normal, missing = slopes.T @ slopes, np.array([0.3, -1.0 / scale, 0.0, 2.0])
    step, decrease = remaining(stopped_at(missing, normal), FREE)
    np.testing.assert_allclose(step, missing, rtol=1e-7, atol=1e-8)
    assert decrease == pytest.approx(missing @ normal @ missing)


def test_nothing_remains_at_a_minimum_nor_in_a_direction_without_information() -> None:
    normal = np.diag([4.0, 0.0])
    step, decrease = remaining(stopped_at(np.array([0.0, 5.0]), normal), FREE)
    assert decrease == 0.0 and step[0] == 0.0


def test_a_width_at_its_floor_does_not_count() -> None:
    """The sum of squares would fall far below the floor, where the fit may not go."""
    at_floor = ChainCoordinates(("coulomb_1", "coulomb_width_1"), np.ones(2), np.array([0.01]))
    x = np.log(np.array([0.1, 0.01]))
    normal, missing = np.diag([100.0, 100.0]), np.array([0.02, -3.0])
    minimum = Minimum(x, Quadratic(1.0, normal, -normal @ missing), 1)
    step, decrease = remaining(minimum, at_floor)
    np.testing.assert_allclose(step, [0.02, 0.0], atol=1e-8)
    assert decrease == pytest.approx(100.0 * 0.02**2)
    above = replace(minimum, x=x + np.array([0.0, 1.0]))
    np.testing.assert_allclose(remaining(above, at_floor)[0], [0.02, -1.0], atol=1e-6)


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return bench.set_up(bench.BENCHES[4], 1)


def test_an_unfinished_fit_is_said_covers_the_truth_and_blames_no_prior(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    period = bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101, 5.0))
    hasty = ChainOptions(ftol_coarse=0.1, ftol_near=0.1, ftol_nearer=0.1, ftol=0.1, other_initial_widths=())
    monkeypatch.setattr(identify, "DEFAULTS", hasty)
    found = identify_chain(period, ChainModel(setup.base), setup.prior)
    assert not found.reached
    assert found.from_prior == ()
    away = np.abs(found.value[: setup.base.count] - setup.truth)
    assert np.mean(away < 1.96 * found.std[: setup.base.count]) > 0.85


def test_a_finished_fit_leaves_less_than_a_standard_error(setup: bench.Setup) -> None:
    covariance, missing = np.diag([4.0, 9.0]), np.array([1.0, 0.0])
    fit = stage2.ChainFit(
        np.zeros(2), covariance, missing, covariance, (), (), 0, 1.0, 1, 1.0, 0.9, np.diag([0.0, 7.0])
    )
    assert fit.reached and not replace(fit, remaining=1.1).reached
    np.testing.assert_allclose(fit.total_covariance, [[5.0, 0.0], [0.0, 16.0]])


def test_the_prior_is_named_by_what_the_data_determine(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distance to the minimum as large as the prior's spread is no lack of data."""
    unfinished = estimate_of(setup, monkeypatch, std=0.01, missing=2.0)
    assert unfinished.from_prior == ()
    assert np.all(unfinished.std[: setup.base.count] > setup.prior.std)
    assert estimate_of(setup, monkeypatch, std=0.7, missing=0.0).from_prior == setup.base.names


def estimate_of(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, std: float, missing: float) -> ChainEstimate:
    """An estimate with these errors of the base parameters, as multiples of the prior's standard deviation."""
    time = np.arange(400) / 400.0
    position = 0.5 * np.sin(2.0 * np.pi * np.outer([1, 2, 3, 4], time))
    period = SettledPeriod(400.0, position, position, 0.0, np.full(4, bench.TICK))
    model = ChainModel(setup.base)
    scale = np.concatenate((setup.prior.std, np.ones(len(model.names) - setup.base.count)))
    covariance = np.diag((std * scale) ** 2)
    fit = stage2.ChainFit(
        np.zeros(scale.size),
        covariance,
        missing * scale,
        covariance,
        (np.zeros((2, 4)),),
        (position,),
        outliers=0,
        correlation_time=1.0,
        iterations=1,
        softness=1.0,
        remaining=0.0,
        neglected=np.zeros_like(covariance),
    )
    monkeypatch.setattr(identify, "_best_fit", lambda *_: fit)
    return identify_chain(period, model, setup.prior)


def test_a_positive_parameter_that_has_run_to_zero_does_not_count() -> None:
    """Its best value is negative, where the fit may not go: the sum of squares would fall, however small it is."""
    names = ChainCoordinates(("viscous_1", "coulomb_1"), np.ones(2), np.zeros(0))
    slopes, best = np.array([1e-9, 0.05]), np.array([-0.01, 0.051])
    normal = np.diag(1e8 * slopes**2)
    missing = (best - slopes) / slopes
    step, decrease = remaining(Minimum(np.log(slopes), Quadratic(1.0, normal, -normal @ missing), 1), names)
    np.testing.assert_allclose(step, [-1.0, 0.02], atol=1e-6)
    assert decrease == pytest.approx(1e8 * 0.001**2, rel=1e-2)


@pytest.mark.parametrize("misfit", [1.0, 1e4])
def test_a_bound_counts_whatever_misfit_it_causes(misfit: float) -> None:
    slopes, best = np.array([1e-9, 0.05]), np.array([-0.01, 0.051])
    normal = np.diag(1e8 * slopes**2)
    minimum = Minimum(np.log(slopes), Quadratic(1.0, normal, -normal @ ((best - slopes) / slopes)), 1)
    problem = SimpleNamespace(
        coordinates=ChainCoordinates(("viscous_1", "coulomb_1"), np.ones(2), np.zeros(0)),
        model=SimpleNamespace(base=SimpleNamespace(count=0, chain=SimpleNamespace(joints=1))),
    )
    std = misfit * 1e-4 * np.ones(2)
    assert stage2._at_bound(cast("ChainProblem", problem), minimum, slopes, std) == ("viscous_1",)


@pytest.mark.parametrize("taken", [1.02, pytest.param(1.2, marks=pytest.mark.slow)])
def test_friction_that_would_have_to_be_negative_is_at_its_bound(setup: bench.Setup, taken: float) -> None:
    period = bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101, 5.0))
    velocity = np.gradient(period.position[0], 1.0 / period.rate)
    torque = period.torque.copy()
    torque[0] -= taken * setup.arm.drives[0].viscous * velocity
    found = identify_chain(replace(period, torque=torque), ChainModel(setup.base), setup.prior)
    assert found.at_bound == ("viscous_1",) and found.reached
