"""Lags that differ from joint to joint, and back-EMF of joints driven by voltage."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.identify import SYSTEMATIC, ChainEstimate, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.simulation.drive_times import DriveTimes
from hil.estimator.data.settled_period import SettledPeriod
from hil.fakes.plants.chain import SpatialChain

BENCH = bench.BENCHES[4]
LAGS = (1.3e-3, 0.6e-3, 1.0e-3, 0.5e-3)
BRAKE, BY_VOLTAGE = 0.5, (1, 2)  # N m s/rad of back-EMF; joints
SUBSTEPS = 16  # back-EMF is held within each


class VoltageChain:
    """The plant with back-EMF at some joints: it passes the same lag as the command, which is scaled to a current."""

    def __init__(self, arm: Any) -> None:
        self._plant = SpatialChain(arm)
        self._constant = np.array(BENCH.torque_constant)
        self._brake = np.zeros(4)
        self._brake[[joint - 1 for joint in BY_VOLTAGE]] = BRAKE
        self._now = 0.0

    @property
    def position(self) -> Sequence[float]:
        return self._plant.position

    @property
    def velocity(self) -> Sequence[float]:
        return self._plant.velocity

    def advance(self, until: float, current: np.ndarray) -> None:
        step = (until - self._now) / SUBSTEPS
        for k in range(SUBSTEPS):
            braked = current - self._brake * np.array(self._plant.velocity) / self._constant
            self._plant.advance(self._now + (k + 1) * step, braked)
        self._now = until


def with_lags(setup: bench.Setup) -> bench.Setup:
    drives = tuple(
        drive.model_copy(update={"current_lag": lag}) for drive, lag in zip(setup.arm.drives, LAGS, strict=True)
    )
    return replace(setup, arm=setup.arm.model_copy(update={"drives": drives}))


def wrong(setup: bench.Setup, found: ChainEstimate) -> tuple[float, float]:
    """Largest error of a base parameter in standard errors, and error of the rigid torque [%]."""
    away = np.abs(found.value[: setup.base.count] - setup.truth) / found.std[: setup.base.count]
    other = bench.path_of(BENCH, setup, 201)
    return float(away.max()), bench.errors(setup, found.value[: setup.base.count], other)["torque_error_percent"]


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return with_lags(bench.set_up(BENCH, 1))


@pytest.fixture(scope="module")
def period(setup: bench.Setup) -> SettledPeriod:
    return bench.record(BENCH, setup, bench.path_of(BENCH, setup, 101))


def test_every_joint_has_its_own_lag(setup: bench.Setup, period: SettledPeriod) -> None:
    found = identify_chain(period, ChainModel(setup.base, lags=True), setup.prior)
    assert wrong(setup, found)[0] < 4.0
    lags = found.parameters["lag"] + np.array([0.0, *(found.parameters[f"lag_difference_{j}"] for j in (2, 3, 4))])
    np.testing.assert_allclose(lags, LAGS, atol=1e-4)


def test_back_emf_is_late(monkeypatch: pytest.MonkeyPatch, setup: bench.Setup) -> None:
    """Braking that is late acts like a smaller inertia; a model without it is wrong by many standard errors."""
    with monkeypatch.context() as patched:
        patched.setattr(bench, "SpatialChain", VoltageChain)
        period = bench.record(BENCH, setup, bench.path_of(BENCH, setup, 101))
    model = ChainModel(setup.base, lags=True, by_voltage=BY_VOLTAGE)
    found = identify_chain(period, model, setup.prior)
    without = identify_chain(period, replace(model, by_voltage=()), setup.prior)
    assert wrong(setup, found)[0] < 4.0
    assert wrong(setup, found)[1] < 0.5 * wrong(setup, without)[1]
    own = setup.base.names.index("inertia_zz_1")
    assert found.value[own] == pytest.approx(setup.truth[own], rel=0.01)
    assert without.value[own] == pytest.approx(setup.truth[own] - BRAKE * LAGS[0], rel=0.01)


@pytest.mark.parametrize(
    "parameters",
    [
        {"lag": 1.2e-3, "lag_difference_2": -0.4e-3},
        {"lag": 1.2e-3, "lag_difference_2": -1.5e-3},  # later than its command by less than nothing
        {"delay": 1.2e-3, "lag_difference_2": -0.5e-3},
    ],
)
def test_slopes_are_those_of_the_torque(parameters: dict[str, float]) -> None:
    command = np.random.default_rng(1).standard_normal((2, 50))

    def torque(values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        return DriveTimes.of(values, 2).torque(command, 400.0, 0.3e-3, 3)

    step = 1e-7
    up, down = ({**parameters, "lag_difference_2": parameters["lag_difference_2"] + s} for s in (step, -step))
    differences = (torque(up)[0][1] - torque(down)[0][1]) / (2 * step)
    np.testing.assert_allclose(torque(parameters)[1][1, 1], differences, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("missing", [{"ripple": 0.002}, {"load": 0.003}])
def test_a_small_missing_term_shows_although_the_residual_looks_like_rounding(
    setup: bench.Setup, period: SettledPeriod, missing: dict[str, float]
) -> None:
    drives = tuple(drive.model_copy(update=missing) for drive in setup.arm.drives)
    other = replace(setup, arm=setup.arm.model_copy(update={"drives": drives}))
    disturbed = bench.record(BENCH, other, bench.path_of(BENCH, setup, 101))
    model = ChainModel(setup.base, lags=True)
    assert identify_chain(period, model, setup.prior).explained
    found = identify_chain(disturbed, model, setup.prior)
    assert found.residual_steps.max() < 1.2 / 12**0.5
    assert found.systematic > SYSTEMATIC
    assert not found.explained
