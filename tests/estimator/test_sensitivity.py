"""Forward sensitivities against differences of the simulation itself, every parameter at once."""

import numpy as np

from estimator.drive import motor_torque, torque_slopes
from estimator.physics import Physics
from estimator.sensitivity import CAUSES, Sensitive
from estimator.simulation import simulate

EACH = {
    **{"viscous": 0.045, "coulomb": 0.055, "offset": 0.004, "coulomb_width": 0.02, "stribeck_rise": 0.4},
    **{"stribeck_velocity": 0.15, "load": 0.05, "viscous_asymmetry": 0.002, "ripple_sin": 0.02, "ripple_cos": 0.01},
    **{"ripple_cycles": 7.0, "zero": 0.01, "torque_scale": 1.1},
}
ARM = {
    **{"inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.01},
    **{"gravity_1": 0.55, "gravity_2": 0.22, "lag": 1e-3, "delay": 2e-4},
    **{f"{name}_{joint}": value for name, value in EACH.items() for joint in (1, 2)},
}
START = {"position_1": -1.57, "position_2": 0.1, "velocity_1": 0.1, "velocity_2": 0.2}
RATE, STEPS, SAMPLES = 400.0, 3, 600


def torque() -> np.ndarray:
    t = np.arange(SAMPLES) / RATE
    return np.stack((0.6 * np.cos(5.0 * t) + 0.2 * np.sin(23.0 * t), 0.3 * np.sin(9.0 * t + 1.0)))


def position(values: dict[str, float]) -> np.ndarray:
    motor = motor_torque(torque(), RATE, 3e-4, STEPS, delay=values["delay"], lag=values["lag"])
    start = np.array([[values["position_1"], values["position_2"]], [values["velocity_1"], values["velocity_2"]]])
    return simulate(Physics.of(values), start, motor, 1.0 / (RATE * STEPS))[0]


def test_derivatives_are_those_of_the_simulation() -> None:
    values = {**ARM, **START}
    start = np.array(list(START.values())).reshape(2, 2)
    motor = motor_torque(torque(), RATE, 3e-4, STEPS, delay=ARM["delay"], lag=ARM["lag"])
    slopes = torque_slopes(torque(), RATE, 3e-4, STEPS, delay=ARM["delay"], lag=ARM["lag"])
    motion = Sensitive(Physics.of(ARM), start, CAUSES, 1.0 / (RATE * STEPS))
    parts = [motion.advance(motor[:, part], slopes[:, :, part]) for part in (slice(0, 250), slice(250, SAMPLES))]
    found = np.concatenate([angle for angle, _ in parts], axis=1)
    derivative = np.concatenate([each for _, each in parts], axis=1)
    assert np.allclose(found, position(values), atol=1e-10)
    for index, cause in enumerate(CAUSES):
        change = 1e-6 * max(abs(values[cause]), 1e-3)
        up, down = (position({**values, cause: values[cause] + sign * change}) for sign in (1.0, -1.0))
        difference = (up - down) / (2.0 * change)
        assert np.abs(derivative[:, :, index] - difference).max() < 1e-4 * np.abs(difference).max(), cause
