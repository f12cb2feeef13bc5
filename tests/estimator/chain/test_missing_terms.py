"""Effects that no term of the model describes, and that are too small to show in the size of the residual."""

from dataclasses import replace

import pytest

from benchmarks import chain as bench
from hil.estimator.chain.identify import EXPLAINED_RESIDUAL, ROUNDING, SYSTEMATIC, ChainEstimate, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel

BENCH = bench.BENCHES[4]


def identified(**effect: float) -> ChainEstimate:
    """Estimate of the four-joint arm with an effect on all of its drives."""
    setup = bench.set_up(BENCH, 1)
    drives = tuple(drive.model_copy(update=effect) for drive in setup.arm.drives)
    real = replace(setup, arm=setup.arm.model_copy(update={"drives": drives}))
    period = bench.record(BENCH, real, bench.path_of(BENCH, setup, 101))
    return identify_chain(period, ChainModel(setup.base, lags=True), setup.prior)


@pytest.mark.parametrize("effect", [{"ripple": 0.002}, {"load": 0.003}])
def test_an_effect_that_hides_in_rounding_is_seen(effect: dict[str, float]) -> None:
    found = identified(**effect)
    assert found.residual_steps.max() < 1.2 * ROUNDING
    assert found.systematic > SYSTEMATIC
    assert not found.explained
    assert not replace(found, residual=0.5 * found.residual).explained  # whatever the size of the residual


def test_a_complete_model_is_not_suspected() -> None:
    found = identified()
    assert found.systematic < 0.7 * SYSTEMATIC
    assert found.explained
    larger = replace(found, residual=found.residual * 1.1 * EXPLAINED_RESIDUAL * ROUNDING / found.residual_steps.max())
    assert not larger.explained
