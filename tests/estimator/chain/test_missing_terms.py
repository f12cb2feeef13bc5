"""Effects that no term of the model describes, and that are too small to show in the size of the residual."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.excitation.fourier_path import Path as Motion
from hil.estimator.chain.identify import EXPLAINED_RESIDUAL, SYSTEMATIC, ChainEstimate, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel

BENCH = bench.BENCHES[4]


NOISE = np.array([0.34, 0.0, 0.13, 0.5])
"""White noise of the encoders, as magnetic encoders have it [encoder steps]."""


@cache
def ready(seconds: float) -> tuple[bench.Setup, Motion]:
    """The four-joint arm and its path, whose design takes longer than the fit."""
    setup = bench.set_up(BENCH, 1)
    return setup, bench.path_of(BENCH, setup, 101, seconds)


def identified(noise: float | np.ndarray = 0.0, first: int = 0, seconds: float = 5.0, **effect: float) -> ChainEstimate:
    """Estimate of the four-joint arm with noisy encoders, and with an effect on its drives from `first` on."""
    setup, path = ready(seconds)
    every = setup.arm.drives
    drives = (*every[:first], *(drive.model_copy(update=effect) for drive in every[first:]))
    real = replace(setup, arm=setup.arm.model_copy(update={"drives": drives}))
    period = bench.record(BENCH, real, path, noise)
    return identify_chain(period, ChainModel(setup.base, lags=True), setup.prior)


@pytest.mark.parametrize("effect", [{"ripple": 0.002}, {"load": 0.003}])
def test_an_effect_that_hides_in_rounding_is_seen(effect: dict[str, float]) -> None:
    found = identified(**effect)
    assert found.over_noise.max() < 1.2
    assert found.systematic > SYSTEMATIC
    assert not found.explained
    assert not replace(found, residual=0.5 * found.residual).explained  # whatever the size of the residual


def test_a_complete_model_is_not_suspected() -> None:
    found = identified(seconds=10.0)
    assert found.systematic < 0.7 * SYSTEMATIC
    assert found.explained
    larger = replace(found, residual=found.residual * 1.1 * EXPLAINED_RESIDUAL / found.over_noise.max())
    assert not larger.explained


def test_noisy_encoders_are_no_missing_effect() -> None:
    found = identified(NOISE)
    np.testing.assert_allclose(found.noise_steps, np.sqrt(1.0 / 12.0 + NOISE**2), rtol=0.12)
    assert found.explained
    assert found.systematic < SYSTEMATIC
    count = found.model.base.count
    away = (found.value[:count] - bench.set_up(BENCH, 1).truth) / found.std[:count]
    assert np.mean(np.abs(away) < 1.96) > 0.85
    assert np.abs(away).max() < 4.0


def test_ripple_is_seen_through_the_noise_of_encoders() -> None:
    found = identified(NOISE, ripple=0.003)
    assert found.systematic > SYSTEMATIC
    assert not found.explained


def test_an_effect_in_one_joint_is_seen_through_the_noise_of_its_encoder() -> None:
    found = identified(np.array([0.1, 0.1, 0.1, 1.7]), first=3, load=0.045)
    assert found.over_noise.max() < 1.15
    assert found.systematic > SYSTEMATIC
    assert not found.explained
