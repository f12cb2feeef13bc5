"""Torque constants of a spatial arm from two periods, one of them with a known mass on its last link."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.calibration import MassOnLink, calibrate_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.errors import ModelError

MASS = MassOnLink(0.25, (0.08, 0.01, -0.02), 3)
TRUE_OVER_ASSUMED = np.array([1.12, 0.9, 1.05, 0.95])


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return bench.set_up(bench.BENCHES[4], 1)


def test_the_mass_acts_like_the_same_mass_in_the_fake_arm(setup: bench.Setup) -> None:
    loaded = setup.arm.model_copy(update={"payload": MASS.mass, "payload_at": MASS.at})
    change = replace(setup, arm=loaded).truth - setup.truth
    np.testing.assert_allclose(MASS.added(setup.base), change, atol=1e-12)


def test_wrong_torque_constants_are_found_and_the_parameters_are_in_true_units(setup: bench.Setup) -> None:
    path = bench.path_of(bench.BENCHES[4], setup, 101, 5.0)
    loaded = replace(setup, arm=setup.arm.model_copy(update={"payload": MASS.mass, "payload_at": MASS.at}))
    recorded = [bench.record(bench.BENCHES[4], each, path) for each in (setup, loaded)]
    assumed = [replace(each, torque=each.torque / TRUE_OVER_ASSUMED[:, None], stabiliser=None) for each in recorded]
    model = ChainModel(setup.base, torque_scale=True, added_mass=True)
    found = calibrate_chain(assumed[0], assumed[1], model, setup.prior, MASS)
    np.testing.assert_allclose(found.factor, TRUE_OVER_ASSUMED, rtol=0.01)
    assert np.all(np.abs(found.factor - TRUE_OVER_ASSUMED) < 4 * found.factor_std)
    assert np.all(found.factor_std < 0.01 * TRUE_OVER_ASSUMED)
    large = np.abs(setup.truth) > 0.1 * np.abs(setup.truth).max()
    np.testing.assert_allclose(found.value[: setup.base.count][large], setup.truth[large], rtol=0.01)
    assert found.residual_steps.max() < 0.31
    assert found.misfit == pytest.approx(1.0, abs=0.1)
    noisier = replace(found, residual_steps=np.array([[0.29], [1.5]]), noise_steps=np.array([[0.29], [1.5]]))
    assert noisier.misfit == pytest.approx(1.0)  # each run has its own noise


def test_a_mass_that_nothing_feels_is_refused(setup: bench.Setup) -> None:
    on_the_axis = MassOnLink(0.2, (0.0, 0.0, 0.0), 0)
    with pytest.raises(ModelError, match="has no effect"):
        calibrate_chain(
            *[None] * 2, ChainModel(setup.base, torque_scale=True, added_mass=True), setup.prior, on_the_axis
        )  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="must be positive"):
        MassOnLink(0.0, (0.1, 0.0, 0.0), 0).added(setup.base)
