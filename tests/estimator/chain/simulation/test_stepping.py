"""The steps of the chain's simulation where a joint breaks away from standstill."""

import numpy as np
import pytest

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation
from hil.estimator.chain.simulation.stepping import COULOMB, FADING, LOAD, SCALE, WIDTH, _broken, _left

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


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_a_joint_that_sticks_needs_no_smaller_steps(load: float) -> None:
    """Within the linear part of its friction, load-dependent friction included, the tangent is exact."""
    p = np.zeros((9, 1))
    p[COULOMB], p[WIDTH], p[FADING], p[LOAD], p[SCALE] = 0.13, 1e-2, 1.0, load, 1.0
    v, t = np.array([1e-5]), np.array([0.5])
    left = np.zeros((4, 1))
    _left.py_func(p, 0, v[0], t[0], left)
    solve = left, None, np.array([[1.0 / (0.007 + STEP * left[1, 0])]])
    assert _broken.py_func(p, v, np.array([1e-3]), t, solve, STEP, 64) == 1
    # A joint that leaves the linear part is divided, as it is without load and as much more friction.
    away = np.array([20.0])
    constant = p.copy()
    constant[COULOMB], constant[LOAD] = 0.13 + load * 0.5, 0.0
    divided = [_broken.py_func(each, v, away, t, solve, STEP, 64) for each in (p, constant)]
    assert divided[0] == divided[1] > 1
