"""Tilt of the base: gravity, base parameters for any gravity, and the sensitivities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import inverse_dynamics
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.tilt import TILT, tilt_axes, tilt_between, tilt_slopes, tilted
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation
from tests.support.chains import random_chain, random_parameters

angles = st.floats(-0.4, 0.4)
downs = st.sampled_from([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (3.0, -4.0, -6.0), (-1.0, 2.0, 9.0)])


@given(angles, angles, downs)
def test_gravity_turns_as_the_base_does(x: float, y: float, down: tuple[float, ...]) -> None:
    gravity = np.array(down)
    base = Rotation.from_rotvec(np.array([x, y]) @ tilt_axes(gravity))
    np.testing.assert_allclose(tilted(gravity, x, y), base.inv().apply(gravity), atol=1e-12)
    np.testing.assert_allclose(tilt_between(gravity, tilted(gravity, x, y)), (x, y), atol=1e-7)


def test_an_upright_base_tilts_about_its_own_x_and_y() -> None:
    np.testing.assert_array_equal(tilt_axes(np.array([0.0, 0.0, -9.81])), np.eye(3)[:2])
    np.testing.assert_allclose(
        tilt_slopes(np.array([0.0, 0.0, -9.81]), 0.0, 0.0), [[0, -9.81, 0], [9.81, 0, 0]], atol=1e-6
    )


def upright(seed: int) -> Chain:
    """Four joints, the first of which is vertical, as gravity is."""
    drawn = random_chain(4, seed)
    axis, rotation = drawn.axis.copy(), drawn.rotation.copy()
    axis[0], rotation[0] = (0.0, 0.0, 1.0), np.eye(3)
    return Chain(rotation, drawn.translation, axis, np.array([0.0, 0.0, -9.81]))


def test_base_parameters_made_for_a_tilt_explain_every_direction_of_gravity() -> None:
    chain = upright(3)
    base, level = BaseParameters.of(chain, tilts=True), BaseParameters.of(chain)
    assert {"moment_x_1", "moment_y_1"} <= set(base.names) - set(level.names)
    every = random_parameters(4, 3)
    q, v, a = np.random.default_rng(1).standard_normal((3, 4, 20))
    for angles_ in ((0.0, 0.0), (0.3, 0.0), (-0.1, 0.2)):
        anyhow = Chain(chain.rotation, chain.translation, chain.axis, tilted(chain.gravity, *angles_))
        right = inverse_dynamics(anyhow, every, q, v, a)
        found = inverse_dynamics(anyhow, base.as_all(base.of_all(every)), q, v, a)
        np.testing.assert_allclose(found, right, atol=1e-9)


def test_the_sensitivities_are_those_of_finite_differences() -> None:
    chain = upright(5)
    base = BaseParameters.of(chain, tilts=True)
    values = dict(zip(base.names, base.of_all(random_parameters(4, 5)).tolist(), strict=True))
    values |= {f"viscous_{joint}": 0.2 for joint in range(1, 5)}
    samples = 60
    torque = 0.3 * np.random.default_rng(2).standard_normal((samples, 1, 4))
    run = ChainRun(torque, np.zeros((samples, 1, 2, 4)), np.full((samples, 4), np.nan), 2e-3)

    def motion(x: float, y: float, names: tuple[str, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
        simulation = Simulation(
            base, values | dict(zip(TILT, (x, y), strict=True)), np.zeros((2, 4)), np.zeros((2, 4)), names
        )
        position, derivative = simulation.go_on(run, slice(0, samples))
        assert position is not None
        return position, derivative

    _, derivative = motion(0.1, -0.05, TILT)
    step = 1e-5
    by_x = (motion(0.1 + step, -0.05)[0] - motion(0.1 - step, -0.05)[0]) / (2.0 * step)
    by_y = (motion(0.1, -0.05 + step)[0] - motion(0.1, -0.05 - step)[0]) / (2.0 * step)
    for k, right in enumerate((by_x, by_y)):
        assert np.abs(right).max() > 1e-3
        np.testing.assert_allclose(derivative[:, :, k], right, atol=2e-3 * np.abs(right).max())


@pytest.mark.parametrize("name", TILT)
def test_its_names_have_no_joint_number(name: str) -> None:
    assert not name.rpartition("_")[2].isdigit()
