"""Drives of a chain whose torque comes late: lags that differ, and the back-EMF of voltage-driven joints."""

import warnings
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.options import DEFAULTS
from hil.estimator.chain.fit.resolved_widths import resolved_widths
from hil.estimator.chain.fit.stage1 import fit_lines
from hil.estimator.chain.fit.starts import first_problem
from hil.estimator.chain.fit.uncertainty import neglected_covariance
from hil.estimator.chain.identify import identify_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.dynamics import mass_matrix
from hil.estimator.chain.model.late_torque import MOST_LOST, as_moving, complete, lags_of, limited, losses, lost_inertia
from hil.estimator.chain.simulation.sensitivity import Simulation
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.simulation.back_emf import UNKNOWN_DELAY

LAGS = (0.6e-3, 1.4e-3, 0.8e-3, 1.2e-3)


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    """The four-joint arm with current loops as different as those of different servo models."""
    plain = bench.set_up(bench.BENCHES[4], 1)
    drives = [drive.model_copy(update={"current_lag": lag}) for drive, lag in zip(plain.arm.drives, LAGS, strict=True)]
    return replace(plain, arm=plain.arm.model_copy(update={"drives": tuple(drives)}))


@pytest.fixture(scope="module")
def period(setup: bench.Setup) -> SettledPeriod:
    return bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101, 5.0))


def test_lags_that_differ_are_found(setup: bench.Setup, period: SettledPeriod) -> None:
    found = identify_chain(period, ChainModel(setup.base, lags=True), setup.prior)
    std = dict(zip(found.names, found.std, strict=True))
    for joint, (lag, true) in enumerate(zip(lags_of(found.parameters, 4), LAGS, strict=True), start=1):
        relative = std["lag"] / LAGS[0] + (
            std[f"lag_ratio_{joint}"] / found.parameters[f"lag_ratio_{joint}"] if joint > 1 else 0
        )
        assert abs(lag / true - 1.0) < 4 * relative
        assert lag == pytest.approx(true, abs=2e-4)
    away = np.abs(found.value[: setup.base.count] - setup.truth) / found.std[: setup.base.count]
    assert np.mean(away < 1.96) > 0.8 and away.max() < 4


@pytest.mark.parametrize("drive", ["lag", "delay_lag"])
def test_derivatives_are_those_of_the_sum_of_squares(setup: bench.Setup, period: SettledPeriod, drive: str) -> None:
    model = ChainModel(setup.base, drive=drive, lags=True, by_voltage=(1, 3))  # type: ignore[arg-type]
    problem, x = first_problem([period], model, fit_lines([period], model, setup.prior), setup.prior, DEFAULTS)
    x = x.copy()
    for name, value in {"lag_ratio_2": 0.3, "delay": 0.4, "coulomb_width_1": np.log(0.1)}.items():
        if name in model.names:
            x[model.names.index(name)] = value
    gradient = problem.evaluate(x).gradient
    step = 1e-5
    for name in ("viscous_1", "viscous_2", "back_emf_1", "back_emf_3", "lag", "lag_ratio_2", "lag_ratio_3"):
        nudge = np.zeros(x.size)
        nudge[model.names.index(name)] = step
        difference = (problem.cost(x + nudge) - problem.cost(x - nudge)) / (
            4 * step
        )  # the cost's gradient is twice J'r
        assert gradient[model.names.index(name)] == pytest.approx(difference, rel=2e-3, abs=1e-2), name


def test_a_diverging_simulation_costs_infinitely_much_without_a_warning(
    setup: bench.Setup, period: SettledPeriod, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ChainModel(setup.base, drive="lag", by_voltage=(1,))
    problem, x = first_problem([period], model, fit_lines([period], model, setup.prior), setup.prior, DEFAULTS)

    def diverge(_: Simulation, run: object, part: slice) -> tuple[None, np.ndarray]:
        del run
        return None, np.full((part.stop - part.start, 4, len(model.names) + 8), np.inf)

    monkeypatch.setattr(Simulation, "go_on", diverge)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert problem.evaluate(x).cost == np.inf


def test_the_narrowest_coulomb_step_is_that_of_the_lighter_joint(setup: bench.Setup, period: SettledPeriod) -> None:
    model = ChainModel(setup.base, drive="lag", by_voltage=(4,))
    parameters = dict(zip(setup.base.names, setup.truth.tolist(), strict=True))
    parameters |= {f"coulomb_{joint}": 0.1 for joint in (1, 2, 3, 4)}
    parameters |= {"viscous_4": 0.2, "back_emf_4": 0.9, "lag": 1e-3}

    def width(parameters: dict[str, float]) -> float:
        problem = SimpleNamespace(model=model, periods=[period], parameters=lambda _: parameters)
        return float(resolved_widths(cast("ChainProblem", problem), np.zeros(1), 1e-4, 4.0)[3])

    assert width(parameters) > 1.0001 * width(parameters | {"lag": 0.0})


def test_a_lagging_back_emf_makes_a_joint_move_like_a_lighter_one(setup: bench.Setup) -> None:
    """In the time domain: a rotor on a lagging voltage, with its back-EMF lagging too, against the equivalent one."""
    parameters = dict(zip(setup.base.names, setup.truth.tolist(), strict=True))
    parameters |= {"back_emf_4": 0.9, "viscous_4": 0.2, "lag": 1e-3, "lag_ratio_4": 1.5}
    moving = as_moving(setup.base, parameters)
    assert moving["armature_4"] == pytest.approx(parameters["armature_4"] - 0.9 * 0.2 * 1.5e-3)
    assert all(moving[name] == parameters[name] for name in parameters if name != "armature_4")
    inertia, generated, rest, lag = 0.004, 0.18, 0.02, 1.5e-3
    s = 2j * np.pi * np.linspace(0.1, 10.0, 50)
    exact = 1.0 / (s * (inertia * s + rest) * (lag * s + 1.0) + s * generated)
    # The equivalent lag is a little larger, the equivalent inertia that of `as_moving` with it.
    longer = lag / (1.0 - generated * lag / inertia)
    equivalent = 1.0 / (s * ((inertia - generated * longer) * s + rest + generated) * (longer * s + 1.0))
    plain = 1.0 / (s * (inertia * s + rest + generated) * (longer * s + 1.0))
    assert np.abs(equivalent / exact - 1.0).max() < 0.02
    assert np.abs(plain / exact - 1.0).max() > 0.04


def by_voltage(setup: bench.Setup, lag: float, joints: tuple[int, ...] = (1, 4)) -> dict[str, float]:
    """The four-joint arm's true parameters, with voltage-driven joints."""
    parameters = dict(zip(setup.base.names, setup.truth.tolist(), strict=True)) | {"lag": lag}
    for joint in joints:
        parameters |= {f"back_emf_{joint}": 0.9, f"viscous_{joint}": 0.2}
    return parameters


def test_no_lag_takes_more_than_half_of_a_joints_inertia(setup: bench.Setup) -> None:
    """Parameters far from the minimum, such as the initial guess of a long lag, still leave an arm that can move."""
    base = setup.base
    parameters = by_voltage(setup, 0.5)
    moving = as_moving(base, parameters)
    for pose in np.random.default_rng(8).uniform(-2.0, 2.0, (20, 4)):
        heavy, light = (
            mass_matrix(base.chain, base.as_all(np.array([each[name] for name in base.names])), pose)
            for each in (parameters, moving)
        )
        left = 1.0 / np.diag(np.linalg.inv(light)) / (1.0 / np.diag(np.linalg.inv(heavy)))
        assert np.linalg.eigvalsh(light)[0] > 0.0
        assert left.min() > 0.8 * MOST_LOST
    names = (*base.names, "viscous_1", "lag")
    derivative = np.random.default_rng(9).standard_normal((3, 4, len(names)))
    changed = derivative.copy()
    complete(losses(base, parameters, names), changed)
    np.testing.assert_array_equal(changed, derivative)  # what is at its limit does not change with its causes
    complete(losses(base, by_voltage(setup, 1e-3), names), changed)
    assert np.abs(changed - derivative)[:, :, -2:].min() > 0.0


def test_a_back_emf_at_its_limit_is_named_where_inertias_depend_on_it(setup: bench.Setup) -> None:
    base, small = setup.base, np.full(setup.base.count, 1e-6)
    assert limited(base, by_voltage(setup, 1e-3), small) == ()
    assert limited(base, by_voltage(setup, 0.5), small) == ("back_emf_4",)
    assert limited(base, by_voltage(setup, 0.5), np.full(base.count, np.inf)) == ()


def test_standard_errors_include_what_a_late_back_emf_neglects(setup: bench.Setup, period: SettledPeriod) -> None:
    base, parameters = setup.base, by_voltage(setup, 2e-3, (4,))

    def std(parameters: dict[str, float]) -> dict[str, float]:
        names = (*base.names, "lag")
        problem = SimpleNamespace(
            model=SimpleNamespace(base=base, joints=4),
            periods=[period],
            count=len(names),
            parameters=lambda _: parameters,
        )
        found = neglected_covariance(cast("ChainProblem", problem), np.zeros(1))
        return dict(zip(names, np.sqrt(np.diag(found)).tolist(), strict=True))

    lost = lost_inertia(base, parameters)[3]
    assert lost == pytest.approx(0.9 * 0.2 * 2e-3)
    inertia = min(
        1.0 / np.linalg.inv(mass_matrix(base.chain, base.as_all(setup.truth), q))[3, 3]
        for q in period.position.T[::100]
    )
    found = std(parameters)
    unequally_late = 0.9 * 0.2 * UNKNOWN_DELAY
    assert found["armature_4"] == pytest.approx(np.hypot(lost**2 / inertia, unequally_late), rel=1e-3)
    assert sum(found.values()) == found["armature_4"]
    assert std(parameters | {"lag": 0.0})["armature_4"] == pytest.approx(unequally_late)
    half = 0.9 * 0.2 * 2e-3  # of a pure delay, which may delay the back-EMF or not
    assert std(parameters | {"lag": 0.0, "delay": 4e-3})["armature_4"] >= half
    assert sum(std(parameters | {"viscous_4": 0.0}).values()) == 0.0, "no back-EMF"
