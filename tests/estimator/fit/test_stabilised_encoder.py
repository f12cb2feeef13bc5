"""Encoder errors in stabilised runs: the stabiliser acts on readings, and its torque is known."""

from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.fit.stabilised_run import StabilisedRun
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import Feedback, respond, resting
from hil.estimator.simulation.encoder import measured, without_errors

RATE, SECONDS = 200.0, 5.0
PARAMETERS = {
    **{"inertia_1": 0.011, "gravity_1": 0.0, "viscous_1": 0.03, "coulomb_1": 0.01, "coulomb_width_1": 0.05},
    **{"offset_1": 0.0, "lag": 0.002},
}
ERRORS = {
    **{"encoder_sin_once_1": 0.003, "encoder_cos_once_1": -0.002},
    **{"encoder_sin_twice_1": 0.002, "encoder_cos_twice_1": -0.0025},
}
FEEDBACK = Feedback(np.array([0.3]), np.array([0.01]), np.zeros(1), np.array([2.0]))


def played(physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Readings (1, samples) [rad] and commanded torque (1, samples) [N m] of a stabilised arm, in steady state."""
    seconds = np.arange(round(RATE * SECONDS)) / RATE
    excitation = 0.1 * (np.sin(2 * np.pi * 0.4 * seconds) + np.sin(2 * np.pi * 1.4 * seconds + 1.0))[None]
    state = resting(np.zeros(1))
    for _ in range(8):
        response = respond(physics, state, excitation, RATE, FEEDBACK)
        state = response.state
    return measured(physics, response.position), response.torque


def stabilised(reading: np.ndarray, torque: np.ndarray) -> StabilisedRun:
    run = SimulatedRun(torque, reading, RATE, 0.0, 4, 8)
    between = 0.5 * (reading + np.roll(reading, -1, axis=1))
    return StabilisedRun(replace(run, pulled_to=between), FEEDBACK.stiffness)


def test_an_encoders_error_exerts_no_torque() -> None:
    """With the true parameters the simulation reads what the arm read; springs to the readings would push it away."""
    physics = Physics.of(PARAMETERS | ERRORS)
    reading, torque = played(physics)
    run = stabilised(reading, torque)
    true = without_errors(physics, reading)
    start = np.stack((true[:, 0], (true[:, 1] - true[:, -1]) * RATE / 2))
    settled = slice(300, None)
    right = run.position(physics, start)[:, settled] - reading[:, settled]
    assert run.run.pulled_to is not None
    to_readings = replace(run.run, pulled_to=measured(physics, run.run.pulled_to))
    wrong = to_readings.position(physics, start, run.stiffness)[:, settled] - reading[:, settled]
    assert np.sqrt(np.mean(right**2)) < 3e-4
    assert np.sqrt(np.mean(right**2)) < 0.25 * np.sqrt(np.mean(wrong**2))


def test_derivatives_are_those_of_the_motion() -> None:
    parameters = PARAMETERS | ERRORS
    reading, torque = played(Physics.of(parameters))
    run = stabilised(reading, torque)
    start = np.stack((reading[:, 0], np.zeros(1)))
    names = tuple(parameters)
    derivative = np.concatenate([d for _, _, d in run.pieces(Physics.of(parameters), start, names)], axis=1)
    for name, value in ERRORS.items():
        more, less = (run.position(Physics.of(parameters | {name: value + h}), start) for h in (1e-4, -1e-4))
        found, true = derivative[:, :, names.index(name)], (more - less) / 2e-4
        assert np.abs(found - true).max() < 1e-4 * np.abs(true).max()


@pytest.mark.slow
def test_the_motion_without_derivatives_is_the_same() -> None:
    """Steps are judged by it: springs, encoders and substeps must agree with the simulation with derivatives."""
    physics = Physics.of(PARAMETERS | ERRORS)
    reading, torque = played(physics)
    run = stabilised(reading, torque)
    start = np.stack((reading[:, 0] + 0.1, np.ones(1)))
    for bristles in ({}, {"presliding_stiffness_1": 5.0, "presliding_damping_1": 0.01}):
        physics = Physics.of(PARAMETERS | ERRORS | bristles)
        for stiffness in (None, np.array([2.0])):
            pieces = list(run.pieces(physics, start, ("inertia_1",), stiffness, 0.5))
            plain = run.position(physics, start, stiffness, 0.5)
            assert plain.shape == (1, 500)
            np.testing.assert_allclose(np.concatenate([each[1] for each in pieces], axis=1), plain, atol=1e-9)


def test_errors_are_taken_out_of_readings() -> None:
    physics = Physics.of(PARAMETERS | ERRORS)
    position = np.linspace(-4.0, 4.0, 101)[None]
    np.testing.assert_allclose(without_errors(physics, measured(physics, position)), position, atol=2e-7)
