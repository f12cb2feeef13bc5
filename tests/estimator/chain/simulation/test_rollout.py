"""Closed-loop simulation of many chains against a fine integration of the equations of motion."""

import numpy as np

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import inverse_dynamics, mass_matrix
from hil.estimator.chain.simulation.rollout import ChainArms, Loop, Pull, is_physical, roll_out, weights
from tests.support.chains import random_chain, random_parameters

RATE = 400.0


def arms_of(joints: int, seed: int, viscous: float = 0.0) -> tuple[ChainArms, np.ndarray]:
    chain, parameters = random_chain(joints, seed), random_parameters(joints, seed)
    base = BaseParameters.of(chain)
    drive = np.zeros((1, 6, joints))
    drive[:, 0], drive[:, 3], drive[:, 4] = viscous, 0.05, 1.0
    return ChainArms(base, base.of_all(parameters)[None], drive), parameters


def loop_of(goal: np.ndarray, pose: np.ndarray, stiffness: float, damping: float) -> Loop:
    n = goal.shape[1]
    return Loop(RATE, goal, np.full(n, stiffness), np.full(n, damping), pose, np.full(n, 1e3))


def test_a_free_motion_is_that_of_the_equations() -> None:
    arms, parameters = arms_of(3, 4, viscous=0.3)
    q, v = np.array([0.3, -0.4, 0.8]), np.zeros(3)
    far = q + 3.0  # no rest pose near, so nothing carries the arm
    found = roll_out(arms, loop_of(np.zeros((40, 3)), far, 0.0, 0.0), q)
    still = np.zeros((3, 1))

    def change(state: np.ndarray) -> np.ndarray:
        q, v = state
        bias = inverse_dynamics(arms.base.chain, parameters, q[:, None], v[:, None], still)[:, 0]
        return np.stack((v, np.linalg.solve(mass_matrix(arms.base.chain, parameters, q), -bias - 0.3 * v)))

    state, h = np.stack((q, v)), 0.2 / RATE
    for _ in range(round(39 / RATE / h)):  # classical Runge-Kutta
        first = change(state)
        second = change(state + 0.5 * h * first)
        third = change(state + 0.5 * h * second)
        state = state + h / 6.0 * (first + 2.0 * second + 2.0 * third + change(state + h * third))
    q, v = state
    np.testing.assert_allclose(found.position[0, -1], q, atol=5e-3)
    np.testing.assert_allclose(found.velocity[0, -1], v, rtol=0.03, atol=0.03)


def test_held_up_it_stays_and_let_go_it_lies() -> None:
    arms, _ = arms_of(3, 5, viscous=0.1)
    pose = np.array([0.2, 0.1, -0.3])
    held = weights(arms, pose)[0]
    up = roll_out(arms, loop_of(np.tile(held, (200, 1)), pose, 50.0, 3.0), pose)
    np.testing.assert_allclose(up.position[0, -1], pose, atol=1e-3)
    limit = Loop(RATE, np.zeros((200, 3)), np.zeros(3), np.zeros(3), pose, 5.0 * np.abs(held))
    lying = roll_out(arms, limit, pose)
    assert np.abs(lying.position[0, -1] - pose).max() < 0.05


def test_a_joint_on_its_stop_stays_on_it_while_another_moves_away() -> None:
    arms, _ = arms_of(3, 5, viscous=0.1)
    pose = np.array([0.2, 0.1, -0.3])
    held = weights(arms, pose)[0]
    goal = np.zeros((200, 3))
    stiffness, damping = np.array([0.0, 0.0, 50.0]), np.array([0.0, 0.0, 3.0])
    goal[:, 2] = 50.0 * 0.8  # the last joint leaves what carries the arm in its rest pose
    side = np.array([0.0, -np.sign(held[1]), 0.0])
    sagged = []
    for stops in (None, side):
        loop = Loop(RATE, goal, stiffness, damping, pose, np.full(3, 50.0), stops)
        sagged.append((side[1] * (roll_out(arms, loop, pose).position[0, :, 1] - pose[1])).max())
    assert sagged[0] > 0.2
    assert sagged[1] < 0.02


def test_a_pull_that_grows_overcomes_friction_that_a_soft_spring_does_not() -> None:
    arms, _ = arms_of(3, 5, viscous=0.1)
    arms.drive[:, 1] = 2.0  # dry friction
    pose = np.array([0.2, 0.1, -0.3])
    goal = np.tile(weights(arms, pose)[0], (1200, 1))
    path = np.tile(pose, (1200, 1))
    ends = []
    for pull in (None, Pull(path, 8.0, 1.0), Pull(path, 8.0, 1e-3)):
        loop = Loop(RATE, goal, np.full(3, 2.0), np.full(3, 0.3), pose, np.full(3, 50.0), pull=pull)
        ends.append(np.abs(roll_out(arms, loop, pose + 0.2).position[0] - pose).max(axis=1).min())
    assert ends[0] > 0.15 and ends[2] > 0.15  # the last one's largest value is smaller than the friction
    assert ends[1] < 0.05


def test_an_arm_of_no_mass_distribution_is_told() -> None:
    arms, _ = arms_of(3, 6)
    poses = np.random.default_rng(1).uniform(-1, 1, (5, 3))
    assert is_physical(arms, poses).all()
    assert not is_physical(ChainArms(arms.base, -arms.rigid, arms.drive), poses).any()
