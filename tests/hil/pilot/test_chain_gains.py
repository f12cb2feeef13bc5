"""Spring and damper of spatial arms: as stiff as the rate allows, and stable."""

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_gains import MOST_DAMPING, MOST_DRIVING, ChainGains
from hil.pilot.chain_paths import chain_config
from hil.plan.stabiliser import DELAY_SAMPLES, too_slow
from tests.support.paths import CONFIGS

RATES = (20.0, 50.0, 125.0, 200.0, 400.0, 1000.0)


@pytest.fixture(scope="module")
def gains() -> ChainGains:
    config = chain_config(load_config(CONFIGS / "koch.toml"))
    return ChainBelief.prior(config).gains(config)


def slowest(inertia: float, stiffness: float, damping: float, friction: float, rate: float) -> float:
    """Spectral radius of one joint's sampled loop, in which each torque follows from the sample before."""
    kept = np.exp(-friction / inertia / rate)
    pushed = (1.0 - kept) / friction  # of velocity, per torque held for one sample
    moved = (1.0 / rate - inertia * pushed) / friction  # of position
    step = [[1.0, inertia * pushed, moved], [0.0, kept, pushed], [-stiffness, -damping, 0.0]]
    return float(np.abs(np.linalg.eigvals(step)).max())


@pytest.mark.parametrize("rate", RATES)
def test_light_and_heavy_joints_come_to_rest_at_every_rate(gains: ChainGains, rate: float) -> None:
    given = gains.at(rate)
    middle = gains.stiffness / (6.0 * np.pi) ** 2
    for inertias in (gains.lightest, middle, 3.0 * middle):
        for each in zip(inertias, given.stiffness, given.damping, gains.friction, strict=True):
            assert slowest(*map(float, each), rate) < 1.0


@pytest.mark.parametrize("rate", RATES)
def test_the_damper_is_weak_enough_for_the_lightest_arm_and_strong_enough_for_the_delay_of_the_spring(
    gains: ChainGains, rate: float
) -> None:
    given = gains.at(rate)
    stiffness, damping = np.array(given.stiffness), np.array(given.damping)
    assert (damping <= 1.01 * MOST_DAMPING * rate * gains.lightest).all()
    assert (DELAY_SAMPLES / rate * stiffness <= 1.02 * MOST_DRIVING * (damping + gains.friction)).all()
    config = load_config(CONFIGS / "koch.toml")
    experiment = config.experiment.model_copy(update={"rate": rate})
    assert too_slow(config.model_copy(update={"stabiliser": given, "experiment": experiment})) == ""


def test_a_low_rate_that_weakens_the_damper_leaves_the_spring_nearly_as_stiff(gains: ChainGains) -> None:
    """A spring weakened with the damper let light arms sag into the table below 200 Hz."""
    assert (np.array(gains.at(125.0).damping) < 0.5 * gains.damping).all()
    assert (gains.stiffness_at(125.0) > 0.7 * gains.stiffness).all()


def test_the_sufficient_rate_is_the_lowest_that_softens_no_spring(gains: ChainGains) -> None:
    rate = gains.sufficient_rate
    assert (gains.stiffness_at(1.001 * rate) == gains.stiffness).all()
    assert (gains.stiffness_at(0.99 * rate) < gains.stiffness).any()
    assert 100.0 < rate < 200.0
