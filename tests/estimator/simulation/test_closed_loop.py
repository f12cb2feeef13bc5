"""The closed-loop simulation compared with the open-loop one, and designed compared with plain excitation."""

import numpy as np
import pytest

from hil.estimator.excitation.multisine import design_multisine, zippered_lines
from hil.estimator.excitation.optimal_design import DesignProblem, Limits, design_optimal
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.closed_loop import Feedback, respond, resting
from hil.estimator.simulation.drive import motor_torque

ARM = {
    **{"inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.01, "gravity_1": 0.55},
    **{"gravity_2": 0.22, "viscous_1": 0.045, "viscous_2": 0.04, "coulomb_1": 0.055, "coulomb_2": 0.05},
    **{"offset_1": 0.004, "offset_2": -0.003},
}
SHAPE = {"coulomb_width_1": 0.05, "coulomb_width_2": 0.05, "lag": 1e-3}
BRISTLES = {"lag": 1e-3} | {
    f"presliding_{name}_{joint}": value for name, value in (("stiffness", 12.0), ("damping", 0.3)) for joint in (1, 2)
}
POSE = np.array([-np.pi / 2, 0.0])
RATE = 200.0


def wave(peak: float, period: float = 4.0):  # type: ignore[no-untyped-def]
    return design_multisine(RATE, period, zippered_lines(period, (0.5, 5.0), 2), [peak, 0.6 * peak], 1)


@pytest.mark.parametrize("friction", [SHAPE, BRISTLES], ids=["dry", "presliding"])
def test_without_feedback_it_is_the_open_loop(friction: dict[str, float]) -> None:
    physics, multisine = Physics.of({**ARM, **friction}), wave(0.5)
    steps = steps_per_sample(RATE)
    torque = motor_torque(multisine.torque, RATE, 0.0, steps, delay=0.0, lag=1e-3)
    start = np.stack((POSE, np.zeros(2)))
    expected, _ = simulate(physics, start, torque, 1 / (RATE * steps))
    state = resting(POSE)
    state[2] = multisine.torque[:, -1]
    found = respond(physics, state, multisine.torque, RATE, Feedback.none(2))
    assert np.abs(found.position - expected).max() < 2e-4, "rad; the two begin with slightly different lag states"


def test_each_joint_has_its_own_lag() -> None:
    physics, multisine = Physics.of({**ARM, **SHAPE, "lag_difference_2": 8e-3}), wave(0.5)
    steps = steps_per_sample(RATE)
    start, state = np.stack((POSE, np.zeros(2))), resting(POSE)
    state[2] = multisine.torque[:, -1]
    found = respond(physics, state, multisine.torque, RATE, Feedback.none(2)).position

    def open_loop(lag: float | np.ndarray) -> np.ndarray:
        torque = motor_torque(multisine.torque, RATE, 0.0, steps, delay=0.0, lag=lag)
        return simulate(physics, start, torque, 1 / (RATE * steps))[0]

    error = np.abs(found - open_loop(physics.lags)).max()
    assert error < 0.1 * np.abs(found - open_loop(1e-3)).max(), "the other joint's lag would be far off"


@pytest.mark.parametrize("friction", [SHAPE, BRISTLES], ids=["dry", "presliding"])
def test_two_halves_are_one_whole_and_one_joint_works(friction: dict[str, float]) -> None:
    feedback = Feedback(np.array([1.0, 0.5]), np.array([0.05, 0.02]), POSE, np.array([2.0, 1.0]))
    physics, command = Physics.of({**ARM, **friction}), wave(0.8).torque
    whole = respond(physics, resting(POSE), command, RATE, feedback)
    first = respond(physics, resting(POSE), command[:, :300], RATE, feedback)
    second = respond(physics, first.state, command[:, 300:], RATE, feedback)
    assert np.abs(np.concatenate((first.position, second.position), axis=1) - whole.position).max() < 1e-9
    assert (np.abs(whole.torque) <= [[2.0], [1.0]]).all()
    pendulum = Physics.of({"inertia_1": 0.01, "gravity_1": 0.3, "viscous_1": 0.02, "lag": 1e-3})
    swing = respond(pendulum, resting(POSE[:1]), command[:1], RATE, Feedback.none(1))
    assert swing.position.shape == (1, command.shape[1]) and np.ptp(swing.position) > 0.1


def test_a_stabiliser_holds_an_arm_on_its_head() -> None:
    upright = np.array([np.pi / 2, 0.0])
    physics = Physics.of({**ARM, **SHAPE, "coulomb_1": 0.0, "coulomb_2": 0.0})
    nothing = np.zeros((2, 1000))
    held = Feedback(np.array([2.5, 1.2]), np.array([0.05, 0.02]), upright, np.array([2.0, 1.0]))
    fallen = respond(physics, resting(upright), nothing, RATE, Feedback.none(2))
    stood = respond(physics, resting(upright), nothing, RATE, held)
    assert np.abs(fallen.position[0] - upright[0]).max() > 1.0
    assert np.abs(stood.position[0] - upright[0]).max() < 0.05


@pytest.mark.slow
def test_designed_excitation_beats_plain_within_the_same_limits() -> None:
    limits = Limits(np.array([-4.2, -3.1]), np.array([1.06, 3.1]), np.array([15.0, 20.0]), np.array([2.1, 1.4]))
    step = np.full(2, 2 * np.pi / 4096)
    problem = DesignProblem(Physics.of({**ARM, **SHAPE}), tuple(ARM), limits, POSE, step, Feedback.none(2))
    plain = wave(1.0)
    design = design_optimal(plain, problem, 1)
    again = design_optimal(plain, problem, 1)
    assert design.worst <= 0.6 * design.plain_worst
    assert (problem.shares(design.multisine) <= 1.0).all()
    assert (again.multisine.torque == design.multisine.torque).all()
