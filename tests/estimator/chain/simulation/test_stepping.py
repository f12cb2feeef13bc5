"""The steps of the chain's simulation where a joint breaks away from standstill."""

import numpy as np
import pytest

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation

STEP = 1.25e-3
TICK = 2.0 * np.pi / 4096


def simulated(phase: float, divided_by: int) -> np.ndarray:
    """Angles of a sticking vertical joint [rad] under a torque that rises and falls beyond its static friction."""
    chain = Chain(np.eye(3)[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([0.0, 0.0, -9.81]))
    base = BaseParameters.of(chain)
    parameters = dict.fromkeys(base.names, 0.007) | {"viscous_1": 0.03, "coulomb_1": 0.13, "offset_1": 0.0}
    parameters |= {"coulomb_width_1": 2e-4, "stribeck_rise_1": 0.3, "stribeck_velocity_1": 0.1}
    samples, steps = 240, 2 * divided_by
    held = 0.22 * np.sin(0.1 * np.arange(samples) + phase)  # rises by a tenth of the friction per sample
    torque = np.repeat(held, steps).reshape(samples, steps, 1)
    run = ChainRun(torque, np.zeros((samples, steps, 2, 1)), np.zeros((samples, 1)), STEP / divided_by, 64)
    position, _ = Simulation(base, parameters, np.zeros((2, 1)), np.zeros((2, 1))).go_on(run, slice(0, samples))
    assert position is not None
    return position


@pytest.mark.parametrize("phase", [0.0, 0.033, 0.067])
def test_breaking_away_is_resolved(phase: float) -> None:
    coarse, fine = simulated(phase, 1), simulated(phase, 16)
    assert np.ptp(fine) > 5 * TICK
    assert np.abs(coarse - fine).max() < 0.05 * TICK
