"""A light arm with large friction: a narrow Coulomb step stays resolved, and cogging is found despite encoder
errors.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.covariance import is_unpredictable
from hil.estimator.fit.levenberg_marquardt import Quadratic
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.selection.candidates import columns_of, simulated_run
from hil.estimator.selection.given import fit_given
from hil.fakes.plants.arm import Arm, base_parameters
from tests.support import recorded_arm

pytestmark = pytest.mark.slow  # its one fit takes a quarter of a minute

PEAK = 0.05  # N m, three times the weight and twice the friction
LINK = {"length": 0.08, "mass": 0.03, "centre": 0.05, "inertia": 2e-5}
DRIVE = {"mass": 0.018, "rotor_inertia": 1.2e-9, "gear_ratio": 288.35, "torque_constant": 0.354, "current_lag": 1e-3}
FRICTION = {"viscous": 0.0068, "coulomb": 0.0187, "stribeck_rise": 0.37, "stribeck_velocity": 0.14, "offset": 0.0025}
COGGING = {"cogging": 0.001, "cogging_cycles": 4}


def wrong_encoder(period: SettledPeriod, once: float, twice: float) -> SettledPeriod:
    """Return the period as read by an encoder with these errors once and twice per turn [encoder steps]."""
    step = period.position_step[:, None]
    error = once * np.sin(period.position - 1.6) + twice * np.sin(2.0 * period.position - 2.7)
    return replace(period, position=np.round(period.position / step + error) * step)


@pytest.fixture(scope="module")
def light_arm() -> Arm:
    drive = {**DRIVE, **FRICTION, **COGGING}
    return Arm.model_validate({"start": (-math.pi / 2,), "links": [LINK], "drives": [drive]})


@pytest.fixture(scope="module")
def light_period(light_arm: Arm) -> SettledPeriod:
    recorded = recorded_arm.record(light_arm, recorded_arm.wave(1, (PEAK,)))
    return wrong_encoder(recorded.period(recorded.position), 0.9, 0.5)


@pytest.fixture(scope="module")
def found(light_period: SettledPeriod) -> Estimate:
    return fit_given(light_period, Model(1, "stribeck", "lag", {"cogging", "encoder"}))


def test_no_fit_ends_at_a_step_that_the_simulation_does_not_resolve(
    light_period: SettledPeriod, found: Estimate
) -> None:
    narrow = Near({**found.parameters, "coulomb_width_1": 1e-4}, found.start)
    again = identify(light_period, found.model, near=narrow)
    assert np.isfinite(again.std).all()
    assert again.std == pytest.approx(found.std, rel=0.5)
    weight = np.ones_like(light_period.position) / light_period.noise[:, None]
    J, _ = columns_of(simulated_run(light_period), Physics.of(again.parameters), again.start, again.names, weight)
    assert not is_unpredictable(Quadratic(1.0, J.T @ J, J[0]), light_period.samples)


def test_cogging_is_found_beside_encoder_errors(found: Estimate) -> None:
    assert found.parameters["cogging_cycles_1"] == pytest.approx(4.0, abs=0.2)
    assert found.residual_steps.max() < 0.30


def test_true_values_lie_within_the_intervals(light_arm: Arm, found: Estimate) -> None:
    std = dict(zip(found.names, found.std.tolist(), strict=True))
    for name, true in base_parameters(light_arm).items():
        assert abs(found.parameters[name] - true) < 3.0 * std[name], name
        assert std[name] < 0.1 * abs(true) or name == "offset_1", name
