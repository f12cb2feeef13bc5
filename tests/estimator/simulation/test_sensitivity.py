"""Forward sensitivities compared with finite differences of the simulation, for all parameters at once."""

import numpy as np
import pytest

from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.models.parameters import ENCODER, Physics
from hil.estimator.simulation.arm import simulate
from hil.estimator.simulation.drive import motor_torque, torque_and_slopes
from hil.estimator.simulation.presliding_sensitivity import PreslidingSensitive, sensitive
from hil.estimator.simulation.sensitivity import CAUSES, Sensitive

EACH = {
    **{"viscous": 0.045, "coulomb": 0.055, "offset": 0.004, "coulomb_width": 0.02, "stribeck_rise": 0.4},
    **{"stribeck_velocity": 0.15, "load": 0.05, "viscous_asymmetry": 0.002, "ripple_sin": 0.02, "ripple_cos": 0.01},
    **{"ripple_cycles": 7.0, "zero": 0.01, "torque_scale": 1.1, "saturation": 0.05, "cable_stiffness": 0.02},
    **{"cogging_sin": 0.004, "cogging_cos": -0.003, "cogging_cycles": 5.0},
}
ARM = {
    **{"inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.01},
    **{"gravity_1": 0.55, "gravity_2": 0.22, "lag": 1e-3, "delay": 2e-4, "lag_difference_2": 4e-4},
    **{f"{name}_{joint}": value for name, value in EACH.items() for joint in (1, 2)},
}
BRISTLES = {f"presliding_{name}_{joint}": v for name, v in (("stiffness", 12.0), ("damping", 0.1)) for joint in (1, 2)}
START = {"position_1": -1.57, "position_2": 0.1, "velocity_1": 0.1, "velocity_2": 0.2}
RATE, STEPS, SAMPLES = 400.0, 3, 600


def torque() -> np.ndarray:
    t = np.arange(SAMPLES) / RATE
    return np.stack((0.6 * np.cos(5.0 * t) + 0.2 * np.sin(23.0 * t), 0.3 * np.sin(9.0 * t + 1.0)))


def position(values: dict[str, float]) -> np.ndarray:
    physics = Physics.of(values)
    motor = motor_torque(torque(), RATE, 3e-4, STEPS, delay=physics.delay, lag=physics.lags)
    start = np.array([[values["position_1"], values["position_2"]], [values["velocity_1"], values["velocity_2"]]])
    return simulate(Physics.of(values), start, motor, 1.0 / (RATE * STEPS))[0]


@pytest.mark.parametrize("bristles", [{}, BRISTLES], ids=["dry", "presliding"])
def test_derivatives_are_those_of_the_simulation(bristles: dict[str, float]) -> None:
    values = {**ARM, **START, **bristles}
    start = np.array(list(START.values())).reshape(2, 2)
    motor, slopes = torque_and_slopes(torque(), RATE, 3e-4, STEPS, delay=ARM["delay"], lag=Physics.of(ARM).lags)
    # With bristles there is no width of the Coulomb step; without them there is no stiffness.
    absent = "coulomb_width" if bristles else "presliding"
    # Back-EMF is differentiated in test_back_emf.py, springs that follow an encoder in test_stabilised_encoder.py.
    causes = tuple(cause for cause in CAUSES if not cause.startswith((absent, "back_emf", "encoder")))
    motion = sensitive(Physics.of(values))(Physics.of(values), start, causes, 1.0 / (RATE * STEPS))
    assert isinstance(motion, PreslidingSensitive) == bool(bristles)
    parts = [motion.advance(motor[:, part], slopes[:, :, part]) for part in (slice(0, 250), slice(250, SAMPLES))]
    found = np.concatenate([angle for angle, _ in parts], axis=1)
    derivative = np.concatenate([each for _, each in parts], axis=1)
    assert np.allclose(found, position(values), atol=1e-10)
    for index, cause in enumerate(causes):
        change = 1e-6 * max(abs(values[cause]), 1e-3)
        up, down = (position({**values, cause: values[cause] + sign * change}) for sign in (1.0, -1.0))
        difference = (up - down) / (2.0 * change)
        assert np.abs(derivative[:, :, index] - difference).max() < 1e-4 * np.abs(difference).max(), cause


@pytest.mark.parametrize("joints", [1, 2])
def test_what_the_encoders_get_wrong_is_differentiated_too(joints: int) -> None:
    each = dict(zip(ENCODER, (0.01, -0.02, 0.015, 0.005), strict=True))
    values = {**ARM, **{f"{name}_{joint}": value for name, value in each.items() for joint in range(1, joints + 1)}}
    start = np.array(list(START.values())).reshape(2, 2)[:, :joints]
    run = SimulatedRun(torque()[:joints], np.zeros((joints, SAMPLES)), RATE, 3e-4, STEPS, 64)
    names = ("encoder_cos_twice_1", "inertia_1", "encoder_sin_once_1", "coulomb_1")
    ((_, read, derivative),) = run.pieces(Physics.of(values), start, names)
    true = SimulatedRun(torque()[:joints], run.measured, RATE, 3e-4, STEPS, 64).position(Physics.of(ARM), start)
    q = true[0]
    wrong = 0.01 * np.sin(q) - 0.02 * np.cos(q) + 0.015 * np.sin(2 * q) + 0.005 * np.cos(2 * q)
    assert np.allclose(read[0], q + wrong, atol=1e-12)
    ((_, without_derivatives, _),) = run.pieces(Physics.of(values), start, ())
    assert np.allclose(without_derivatives, read, atol=1e-12)
    assert derivative.shape == (joints, SAMPLES, len(names) + 2 * joints)
    for index, name in enumerate(names):
        change = 1e-6 * max(abs(values[name]), 1e-3)
        up, down = (run.position(Physics.of({**values, name: values[name] + s * change}), start) for s in (1.0, -1.0))
        difference = (up - down) / (2.0 * change)
        assert np.abs(derivative[:, :, index] - difference).max() < 1e-4 * np.abs(difference).max(), name


def test_pulled_motion_keeps_to_its_target_and_has_its_own_derivatives() -> None:
    start = np.array(list(START.values())).reshape(2, 2)
    motor, slopes = torque_and_slopes(torque(), RATE, 3e-4, STEPS, delay=ARM["delay"], lag=Physics.of(ARM).lags)
    target = np.tile([[-1.5], [0.1]], SAMPLES)

    def pulled(values: dict[str, float], pull: float) -> tuple[np.ndarray, np.ndarray]:
        physics, step = Physics.of(values), 1.0 / (RATE * STEPS)
        motion = Sensitive(physics, start, ("inertia_1",), step, tracking_stiffness=np.full(2, pull))
        return motion.advance(motor, slopes, target)

    free, held = (pulled(ARM, pull)[0] for pull in (0.0, 20.0))
    assert np.allclose(free, position({**ARM, **START}), atol=1e-10)
    assert np.abs(held - target)[:, 200:].max() < 0.3 * np.abs(free - target)[:, 200:].max()
    change = 1e-6 * ARM["inertia_1"]
    up, down = (pulled({**ARM, "inertia_1": ARM["inertia_1"] + sign * change}, 20.0)[0] for sign in (1.0, -1.0))
    difference = (up - down) / (2.0 * change)
    assert np.abs(pulled(ARM, 20.0)[1][:, :, 0] - difference).max() < 1e-4 * np.abs(difference).max()


def test_rough_steps_stay_within_a_tenth_of_an_encoder_step() -> None:
    values = {**ARM, **START}
    motor = motor_torque(torque(), RATE, 3e-4, 1, delay=values["delay"], lag=Physics.of(values).lags)
    start = np.array(list(START.values())).reshape(2, 2)
    rough = simulate(Physics.of(values), start, motor, 1.0 / RATE)[0]
    assert np.sqrt(np.mean((rough - position(values)) ** 2)) < 0.1 * 2.0 * np.pi / 4096


def test_normal_equations_are_those_of_numpy() -> None:
    random = np.random.default_rng(1)
    for rows in (1, 4, 7):
        J, r, weight = random.normal(size=(rows, 3)), random.normal(size=rows), random.uniform(size=rows)
        product, gradient = normal_equations(J, r, weight)
        assert np.allclose(product, J.T @ np.diag(weight) @ J) and np.allclose(gradient, J.T @ (weight * r))
