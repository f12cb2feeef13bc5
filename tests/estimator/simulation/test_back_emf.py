"""Joints driven by voltage: the motion of a motor with a winding, and derivatives by its constituents."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.back_emf import UNKNOWN_DELAY, neglected, neglected_inertia

RATE, SAMPLES = 400.0, 800
TIME = np.arange(SAMPLES) / RATE
INERTIA, GRAVITY, VISCOUS, GENERATED, WINDING = 0.006, 0.18, 0.02, 0.24, 1.8e-3
ARM = {
    **{"inertia_1": 0.008, "coupling": 0.0003, "inertia_2": 0.0005, "armature_2": 0.003},
    **{"gravity_1": 0.18, "gravity_2": 0.03, "viscous_1": 0.24, "viscous_2": 0.25},
    **{"coulomb_1": 0.03, "coulomb_2": 0.03, "coulomb_width_1": 0.02, "coulomb_width_2": 0.02},
    **{"stribeck_rise_1": 0.3, "stribeck_velocity_1": 0.2, "torque_scale_2": 1.1, "load_1": 0.05, "load_2": 0.06},
    **{
        "ripple_sin_1": 0.05,
        "ripple_cycles_1": 5.0,
        "ripple_sin_2": 0.05,
        "ripple_cos_2": 0.02,
        "ripple_cycles_2": 7.0,
    },
    **{"saturation_1": 0.3, "saturation_2": 0.2, "encoder_sin_once_1": 2e-3},
    **{"back_emf_1": 0.9, "back_emf_2": 0.85, "lag": 2e-3, "lag_difference_2": -3e-4},
}
BRISTLES = {f"presliding_{what}_{j}": v for what, v in (("stiffness", 20.0), ("damping", 0.1)) for j in (1, 2)}


def command() -> np.ndarray:
    low, high = 2 * np.pi * 0.5 * TIME, 2 * np.pi * 4.0 * TIME
    return np.stack((0.2 * np.sin(low) + 0.15 * np.sin(high), 0.2 * np.sin(2 * low) + 0.1 * np.cos(high)))


def run_of(torque: np.ndarray) -> SimulatedRun:
    return SimulatedRun(torque, np.zeros_like(torque), RATE, 0.0, 3, 16)


def with_winding(torque: np.ndarray) -> np.ndarray:
    """A pendulum whose current follows voltage less back-EMF through its winding."""

    def slope(t: float, x: np.ndarray) -> list[float]:
        voltage = torque[min(int(t * RATE + 1e-9), SAMPLES - 1)]
        acceleration = (x[2] - VISCOUS * x[1] - GRAVITY * np.cos(x[0])) / INERTIA
        return [x[1], acceleration, (voltage - GENERATED * x[1] - x[2]) / WINDING]

    # Twice: the estimator's torque is that of a repeated period.
    state, position = np.array([-np.pi / 2, 0.0, 0.0]), np.empty(0)
    for _ in range(2):
        found = solve_ivp(slope, (0.0, SAMPLES / RATE), state, t_eval=[*TIME, SAMPLES / RATE], max_step=5e-4, rtol=1e-8)
        state, position, velocity = found.y[:, -1], found.y[0, :-1], found.y[1, :-1]
    return np.stack((position, velocity))


def test_the_motion_is_that_of_a_motor_with_a_winding() -> None:
    torque = command()[0]
    true = with_winding(torque)
    # The lag that goes with a smaller inertia: lag' (J - b lag') = lag J.
    late = (INERTIA - np.sqrt(INERTIA**2 - 4 * GENERATED * WINDING * INERTIA)) / (2 * GENERATED)
    brake = GENERATED + VISCOUS
    pendulum = {"inertia_1": INERTIA, "gravity_1": GRAVITY, "viscous_1": brake, "lag": late, "coulomb_width_1": 0.1}
    run = run_of(torque[None])

    def off(**given: float) -> float:
        found = run.position(Physics.of(pendulum | given), true[:, :1])[0]
        return float(np.sqrt(np.mean((found - true[0]) ** 2)) / np.std(true[0]))

    assert off(back_emf_1=GENERATED / brake) < 1e-3
    assert off(lag=WINDING) > 3e-3, "what was assumed before: an undelayed brake"


@pytest.mark.parametrize("wait", [0.0, 0.5e-3, 1e-3])
@pytest.mark.parametrize("sampled", [0.5e-3, 0.0], ids=["sampled back-EMF", "continuous back-EMF"])
def test_standard_errors_include_a_goal_that_waits_for_the_servos_loop(wait: float, sampled: float) -> None:
    """The bias is first-order in the delay, and no slow motion shows it: a run of the loop that happens to follow each
    goal at once made an inertia 2 % wrong, at 4.5 standard errors.

    wait: time until the servo's loop of 1 ms takes over a goal [s]. sampled: mean delay of a back-EMF that is held
    until the loop's next run [s].
    """
    s = 2j * np.pi * np.linspace(0.1, 2.0, 20)
    brake, winding = GENERATED + VISCOUS, 1.0 / (1.0 + 1e-3 * s)
    response = np.exp(-wait * s) * winding / (INERTIA * s + VISCOUS + GENERATED * np.exp(-sampled * s) * winding)

    def misfit(x: np.ndarray) -> np.ndarray:
        inertia, late = x * (INERTIA, 1e-3)
        modelled = 1.0 / ((late * s + 1.0) * ((inertia - GENERATED * late) * s + brake))
        off = modelled / response - 1.0
        return np.concatenate((off.real, off.imag))

    found = least_squares(misfit, np.ones(2)).x
    assert np.abs(misfit(found)).max() < 2e-3, "the motion does not reveal the delay"
    inertia, late = found * (INERTIA, 1e-3)
    assert inertia - INERTIA == pytest.approx(GENERATED * (wait - sampled), abs=0.15 * GENERATED * UNKNOWN_DELAY)
    assert abs(inertia - INERTIA) < 2.1 * neglected_inertia(GENERATED, GENERATED * late, inertia, 0.0)
    planar = Physics.of({"inertia_1": inertia, "viscous_1": brake, "back_emf_1": GENERATED / brake, "lag": late})
    assert neglected(planar) == {
        "inertia_1": pytest.approx(neglected_inertia(GENERATED, GENERATED * late, inertia, 0.0))
    }


@pytest.mark.parametrize("bristles", [{}, BRISTLES], ids=["dry", "presliding"])
def test_derivatives_are_those_of_the_simulation(bristles: dict[str, float]) -> None:
    values, start = {**ARM, **bristles}, np.array([[-1.5, 0.1], [0.0, 0.0]])
    run = run_of(command())
    names = tuple(name for name in values if "width" not in name and "cycles" not in name)
    ((_, found, derivative),) = run.pieces(Physics.of(values), start, names)
    assert np.allclose(found, run.position(Physics.of(values), start), atol=1e-12)
    for index, name in enumerate(names):
        change = 1e-6 * abs(values[name])  # at 1e-5, curvature alone is 1e-4 of a slope
        more, less = (run.position(Physics.of({**values, name: values[name] + c}), start) for c in (change, -change))
        slope = (more - less) / (2 * change)
        assert np.abs(derivative[:, :, index] - slope).max() < 1e-4 * np.abs(slope).max(), name


def test_only_joints_driven_by_voltage_have_it() -> None:
    assert "back_emf_2" in Model(2, by_voltage=(2,)).names and "back_emf_1" not in Model(2, by_voltage=(2,)).names
    assert not any(name.startswith("back_emf") for name in Model(2).names)
