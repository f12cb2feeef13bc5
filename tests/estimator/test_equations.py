"""Arm model, Fourier lines, held command and compiled simulation, each compared with an independent derivation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hil.estimator.data.fourier import cut_off, held_lines, lines_of, motion_of
from hil.estimator.data.periodicity import correlation_of_changes, decay_of, period_difference
from hil.estimator.errors import ModelError, ShapeError
from hil.estimator.fit.reparametrisation import Coordinates, Sizes, scales_of
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names, units_of
from hil.estimator.options import CoordinateOptions
from hil.estimator.simulation.arm import simulate
from hil.estimator.simulation.drive import motor_torque

small = st.floats(-3.0, 3.0)


@given(arrays(float, (12,), elements=small), arrays(float, (3, 2), elements=small))
def test_regressor_gives_the_torque_of_the_written_equations(theta: np.ndarray, motion: np.ndarray) -> None:
    a, b, d, ia, g1, g2, fv1, fv2, fc1, fc2, o1, o2 = theta
    (q1, q2), (v1, v2), (a1, a2) = motion
    s, c = np.sin(q2), np.cos(q2)
    tau1 = (a + d + 2 * b * c) * a1 + (d + b * c) * a2 - b * s * (2 * v1 * v2 + v2**2)
    tau1 += g1 * np.cos(q1) + g2 * np.cos(q1 + q2) + fv1 * v1 + fc1 * np.sign(v1) + o1
    tau2 = (d + b * c) * a1 + (d + ia) * a2 + b * s * v1**2
    tau2 += g2 * np.cos(q1 + q2) + fv2 * v2 + fc2 * np.sign(v2) + o2
    torque = regressor(*(part[:, None] for part in motion)) @ theta
    assert np.allclose(torque[:, 0], (tau1, tau2), atol=1e-9)


def test_names_units_and_errors() -> None:
    assert len(units_of(base_names(2))) == len(base_names(2)) == 12
    assert base_names(1) == ("inertia_1", "gravity_1", "viscous_1", "coulomb_1", "offset_1")
    assert Model(2, "stribeck_load", "lag").names[12:] == (
        *("coulomb_width_1", "coulomb_width_2", "stribeck_rise_1", "stribeck_rise_2"),
        *("stribeck_velocity_1", "stribeck_velocity_2", "load_1", "load_2", "lag"),
    )
    assert len(Model(2, "stribeck_load", "lag").units) == 21
    with pytest.raises(ModelError, match="3 joints"):
        base_names(3)
    with pytest.raises(ModelError, match="'dahl'"):
        Model(2, "dahl")  # type: ignore[arg-type]
    with pytest.raises(ShapeError):
        regressor(np.zeros((2, 5)), np.zeros((2, 4)), np.zeros((2, 5)))


@given(arrays(float, (5,), elements=small), arrays(float, (5,), elements=small))
def test_derivatives_of_a_periodic_motion_are_exact(cosine: np.ndarray, sine: np.ndarray) -> None:
    w0 = 2.0 * np.pi / 3.0
    t = 3.0 * np.arange(64) / 64
    turns = w0 * np.arange(1, 6)[:, None] * t
    wave = cosine @ np.cos(turns) + sine @ np.sin(turns)
    speeds = w0 * np.arange(1, 6)
    slope = (sine * speeds) @ np.cos(turns) - (cosine * speeds) @ np.sin(turns)
    bend = -((cosine * speeds**2) @ np.cos(turns)) - (sine * speeds**2) @ np.sin(turns)
    motion = motion_of(lines_of(wave[None]), 5, w0, 64)
    assert np.allclose(motion.position[0], wave, atol=1e-9)
    assert np.allclose(motion.velocity[0], slope, atol=1e-9)
    assert np.allclose(motion.acceleration[0], bend, atol=1e-8)


@pytest.mark.parametrize("last", [20, 60])
def test_the_cut_off_finds_where_signal_meets_noise(last: int) -> None:
    random = np.random.default_rng(last)
    t = np.arange(4000) / 4000
    signal = sum(np.cos(2.0 * np.pi * k * t + random.uniform(0.0, 6.0)) for k in range(1, last + 1))
    noisy = np.stack((0.1 * signal, 0.0 * signal)) + 1e-3 * random.standard_normal((2, 4000))
    assert last <= cut_off(lines_of(noisy)) <= last + 8


@given(arrays(float, (1, 16), elements=small), st.floats(-2e-3, 1.2e-2))
def test_held_lines_are_those_of_the_staircase(command: np.ndarray, delay: float) -> None:
    """Compare with the exact integral of the staircase, piece by piece."""
    rate, samples = 100.0, 16
    edges = np.arange(samples) / rate + delay
    for k in range(1, 7):
        w = 2.0 * np.pi * k * rate / samples
        pieces = (np.exp(-1j * w * edges) - np.exp(-1j * w * (edges + 1.0 / rate))) / (1j * w)
        line = np.sum(command[0] * pieces) * rate / samples
        assert abs(held_lines(command, rate, delay)[0, k] - line) < 1e-12


@settings(max_examples=30, deadline=None)
@given(
    arrays(float, (1, 12), elements=small),
    st.floats(0.0, 4e-3),
    st.floats(-3e-3, 6e-3),
    st.sampled_from([0.0, 5e-4, 4e-3]),
)
def test_motor_torque_is_the_mean_of_the_late_command(
    command: np.ndarray, sample: float, delay: float, lag: float
) -> None:
    """Compare with a lag integrated in a thousand steps per sample until it is periodic."""
    rate, steps, fine = 400.0, 3, 999
    means = motor_torque(command, rate, sample, steps, delay=delay, lag=lag)
    t = (np.arange(12 * fine) + 0.5) / (rate * fine) + sample - delay
    late = command[0, np.floor(t * rate).astype(int) % 12]
    if lag:
        turn = 2j * np.pi * np.fft.rfftfreq(t.size, 1.0 / (rate * fine))
        late = np.fft.irfft(np.fft.rfft(late) / (1.0 + turn * lag), t.size)
    expected = late.reshape(12, steps, fine // steps).mean(axis=2)
    assert np.allclose(means[0], expected, atol=6.0 * 2.0 / (fine / steps))
    assert np.isclose(means.mean(), command.mean(), atol=1e-12)


@given(arrays(float, (21,), elements=st.floats(-2.0, 2.0)))
def test_every_coordinate_is_a_physical_arm(x: np.ndarray) -> None:
    names = Model(2, "stribeck_load", "lag").names
    there = Coordinates(names, scales_of(names, Sizes(0.3, 3.0, 0.02)), CoordinateOptions(1e-3))
    value = dict(zip(names, there.values(x), strict=True))
    a, b, d, ia = (value[name] for name in ("inertia_1", "coupling", "inertia_2", "armature_2"))
    for c in np.cos(np.linspace(0.0, np.pi, 7)):
        M = np.array([[a + d + 2 * b * c, d + b * c], [d + b * c, d + ia]])
        assert np.linalg.eigvalsh(M).min() > 0.0
    assert all(value[name] >= 0.0 for name in names if not name.startswith(("coupling", "gravity", "offset")))
    moved = there.coordinates(there.values(x))
    assert np.allclose(there.values(moved), there.values(x), rtol=1e-2, atol=0.05)
    change = 1e-6 * np.eye(21)
    slopes = np.stack([(there.values(x + e) - there.values(x - e)) / 2e-6 for e in change], axis=1)
    assert np.allclose(there.slopes(x), slopes, rtol=1e-5, atol=1e-8)


def test_simulation_obeys_inverse_dynamics() -> None:
    """The torques that inverse dynamics computes for a motion produce that motion."""
    names = base_names(2)
    theta = np.array([0.018, 0.0033, 0.0028, 0.01, 0.55, 0.22, 0.045, 0.04, 0.055, 0.05, 0.004, -0.003])
    width, rate, steps, samples = 0.2, 400.0, 8, 400
    t = (np.arange(samples * steps) + 0.5) / (rate * steps)
    speed, size, shift = np.array([[3.0], [5.0]]), np.array([[0.8], [0.6]]), np.array([[-1.57], [0.3]])
    position, velocity = shift + size * np.sin(speed * t), size * speed * np.cos(speed * t)
    torque = regressor(position, velocity, -size * speed**2 * np.sin(speed * t), width) @ theta
    physics = Physics.of(
        {**dict(zip(names, theta.tolist(), strict=True)), "coulomb_width_1": width, "coulomb_width_2": width}
    )
    start = np.stack((shift[:, 0], (size * speed)[:, 0]))
    found, _ = simulate(physics, start, torque.reshape(2, samples, steps), 1.0 / (rate * steps))
    sampled = np.arange(samples) / rate
    assert np.abs(found - (shift + size * np.sin(speed * sampled))).max() < 1e-5


def test_settling_is_seen_in_the_difference_of_periods() -> None:
    t = 2.0 * np.pi * np.arange(200) / 200
    periods = np.stack([np.stack((np.sin(t) + size, 2.0 * np.cos(t))) for size in (0.1, 0.01, 0.0)])
    periods[1, 1, 7] = np.nan
    settling = period_difference(periods)
    assert np.allclose(settling.difference, [[0.09, 0.0], [0.01, 0.0]], atol=1e-12)
    assert np.allclose(settling.relative[:, 0], np.array([0.09, 0.01]) * np.sqrt(2.0))
    with pytest.raises(ShapeError):
        period_difference(periods[:1])


@pytest.mark.filterwarnings("error")
def test_a_joint_that_never_answered_is_not_settled() -> None:
    periods = np.ones((2, 2, 50))
    periods[1, 1] = np.nan
    assert period_difference(periods).relative.tolist() == [[0.0, np.inf]]


def test_a_steady_decrease_is_told_from_play_and_tells_the_time_it_takes() -> None:
    slow = [0.2, *(0.05 * 0.8**n for n in range(5))]
    decay = decay_of(slow, 0.01)
    assert decay is not None and decay.ratio == pytest.approx(0.8)
    assert slow[-1] * 0.8**decay.further <= 0.01 < slow[-1] * 0.8 ** (decay.further - 1)
    play, steady, bumps = [0.2, 0.03, 0.05, 0.02, 0.04], [0.2, 0.05, 0.05, 0.05], [0.291, 0.341, 0.133, 0.098, 0.08]
    for others in (play, steady, bumps, slow[:2], [0.2, np.inf, 0.05], [0.9, 0.85, 0.8245]):
        assert decay_of(others, 1e-5) is None


@pytest.mark.parametrize(("ratio", "turned", "drifts"), [(0.8, False, True), (0.8, True, False), (0.5, False, False)])
def test_warming_friction_changes_the_motion_slowly_and_always_in_the_same_direction(
    ratio: float, turned: bool, drifts: bool
) -> None:
    wave = np.sin(np.linspace(0.0, 2.0 * np.pi, 101)[:-1])
    sizes = np.cumsum([0.0, *(0.1 * (-ratio if turned else ratio) ** n for n in range(5))])
    periods = (1.0 + sizes)[:, None, None] * np.stack([wave, 0.1 * wave])
    periods[-2, 0, 77] = np.nan
    decay = decay_of(period_difference(periods).relative[:, 0].tolist(), 1e-3)
    assert decay is not None
    assert decay.is_drift(correlation_of_changes(periods[-3:])) is drifts
