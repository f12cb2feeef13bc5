"""End to end: independently simulated arms with rounded positions, identified from one period."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.estimator import linalg
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError, RecordingError, ShapeError, StandstillError, UnidentifiableError
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.fit.stage1 import fit_lines
from hil.estimator.identify import Estimate, identify, predict
from hil.estimator.models.model import Model
from hil.fakes.plants.arm import Arm, base_parameters

Recorder = Callable[[Arm, Multisine], SettledPeriod]
Wave = Callable[..., Multisine]


def errors(estimate: Estimate, arm: Arm) -> dict[str, float]:
    """Return the relative errors of the base parameters."""
    found = estimate.parameters
    return {name: found[name] / true - 1.0 for name, true in base_parameters(arm).items()}


def worst(estimate: Estimate, arm: Arm, *kinds: str) -> float:
    return max(abs(error) for name, error in errors(estimate, arm).items() if name.startswith(kinds))


def offsets_in_std(estimate: Estimate, arm: Arm) -> list[float]:
    std = dict(zip(estimate.names, estimate.std.tolist(), strict=True))
    return [
        abs(estimate.parameters[name] - true) / std[name]
        for name, true in base_parameters(arm).items()
        if name.startswith("offset")
    ]


def held_out_error(estimate: Estimate, period: SettledPeriod) -> np.ndarray:
    """Return the RMS of the free prediction's error relative to that of the motion, per joint."""
    predicted = predict(estimate, period.torque, period.rate, period.command_to_sample)
    return np.asarray(np.sqrt(np.mean((predicted - period.position) ** 2, axis=1)) / period.position.std(axis=1))


RIGID = ("inertia", "coupling", "armature")


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("seed", "peak"),
    [
        (1, (0.8, 0.42)),
        (2, (0.6, 0.35)),
        pytest.param(3, (0.8, 0.42), marks=SLOW),  # needs further starts, and so several times the time
        pytest.param(16, (0.7, 0.4), marks=SLOW),
    ],
)
def test_ideal_arm_within_a_fifth_of_a_percent(
    ideal_arm: Arm, recorded: Recorder, wave: Wave, seed: int, peak: tuple[float, float]
) -> None:
    estimate = identify(recorded(ideal_arm, wave(seed, peak)), Model(2))
    assert worst(estimate, ideal_arm, *RIGID, "gravity", "viscous", "coulomb") < 0.002
    assert max(offsets_in_std(estimate, ideal_arm)) < 3.0
    assert estimate.residual_steps.max() <= 0.295
    assert abs(estimate.parameters["delay"]) < 3e-5


def test_sticking_arm_is_found_and_predicted(
    sticking_arm: Arm, sticking_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    assert np.degrees(np.ptp(sticking_period.position, axis=1)).min() > 100.0
    estimate = identify(sticking_period, Model(2, "stribeck", "lag"))
    assert worst(estimate, sticking_arm, "gravity") < 0.001
    assert worst(estimate, sticking_arm, *RIGID) < 0.005
    assert estimate.residual_steps.max() <= 0.30
    assert estimate.parameters["lag"] == pytest.approx(1e-3, rel=0.03)
    assert estimate.parameters["stribeck_rise_1"] == pytest.approx(0.4, rel=0.2)
    assert held_out_error(estimate, recorded(sticking_arm, wave(2, (0.8, 0.42)))).max() < 0.001


def test_a_friction_model_that_lacks_something_shows_in_the_residual(
    sticking_arm: Arm, sticking_period: SettledPeriod
) -> None:
    estimate = identify(sticking_period, Model(2, "coulomb", "lag"))
    assert estimate.residual_steps.max() > 0.5
    assert worst(estimate, sticking_arm, "gravity") < 0.01
    assert worst(estimate, sticking_arm, *RIGID) < 0.05


def test_a_pendulum_is_the_same_code(pendulum: Arm, recorded: Recorder, wave: Wave) -> None:
    estimate = identify(recorded(pendulum, wave(4, (0.4,))), Model(1))
    assert worst(estimate, pendulum, "inertia", "gravity", "viscous", "coulomb") < 0.002
    assert max(offsets_in_std(estimate, pendulum)) < 3.0
    assert estimate.residual_steps.max() <= 0.295
    assert held_out_error(estimate, recorded(pendulum, wave(5, (0.4,)))).max() < 0.001


def test_the_same_period_gives_the_same_digits(ideal_period: SettledPeriod) -> None:
    once, again = (identify(ideal_period, Model(2)) for _ in range(2))
    assert np.array_equal(once.value, again.value)
    assert np.array_equal(once.covariance, again.covariance)
    assert np.array_equal(once.position, again.position)


def test_lost_samples_cost_little(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    position = ideal_period.position.copy()
    position[:, np.random.default_rng(1).random(ideal_period.samples) < 0.03] = np.nan
    estimate = identify(replace(ideal_period, position=position), Model(2))
    assert worst(estimate, ideal_arm, *RIGID, "gravity", "viscous", "coulomb") < 0.002
    assert estimate.residual_steps.max() <= 0.295
    assert np.array_equal(np.isnan(estimate.residual), np.isnan(position))


def test_regression_alone_is_close_for_two_small_decompositions(
    ideal_arm: Arm, ideal_period: SettledPeriod, monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes: list[tuple[int, ...]] = []
    svd = linalg.svd

    def counted(matrix: np.ndarray, **how: Any) -> Any:
        shapes.append(matrix.shape)
        return svd(matrix, **how)

    monkeypatch.setattr(linalg, "svd", counted)
    linear = fit_lines(ideal_period)
    lines = linear.harmonics[0] + 1
    assert shapes == [(4 * lines, 13)] * 2  # real and imaginary parts of two joints; twelve parameters and the delay
    assert lines < ideal_period.samples / 10
    truth = base_parameters(ideal_arm)
    for name, value in zip(linear.names, linear.value, strict=True):
        if not name.startswith("offset"):
            assert value == pytest.approx(truth[name], rel=0.03)


def test_regression_sees_the_lag_as_a_delay(sticking_period: SettledPeriod) -> None:
    assert fit_lines(sticking_period).delay == pytest.approx(1e-3, rel=0.2)


def test_standard_errors_are_of_the_size_of_the_errors(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, Model(2))
    truth = np.array(list(base_parameters(ideal_arm).values()))
    z = (estimate.value[:12] - truth) / estimate.std[:12]
    assert 0.2 < np.sqrt(np.mean(z**2)) < 2.5


def test_what_is_no_settled_period_is_refused(ideal_period: SettledPeriod) -> None:
    still = np.zeros_like(ideal_period.position)
    with pytest.raises(StandstillError, match="joint 1 was held by friction and moved by only 0 rad"):
        replace(ideal_period, position=still)
    turning = ideal_period.position + np.linspace(0.0, 2.0 * np.pi, ideal_period.samples)
    with pytest.raises(RecordingError, match="went over the top or has not settled"):
        replace(ideal_period, position=turning)
    mostly_lost = ideal_period.position.copy()
    mostly_lost[1, 10:] = np.nan
    with pytest.raises(RecordingError, match="joint 2: 0 % of 4000 samples"):
        replace(ideal_period, position=mostly_lost)
    with pytest.raises(ShapeError, match="one per joint"):
        replace(ideal_period, position_step=np.ones(3))
    unknown = ideal_period.torque.copy()
    unknown[0, 3] = np.inf
    with pytest.raises(RecordingError, match="joint 1: 1 commanded torques"):
        replace(ideal_period, torque=unknown)
    with pytest.raises(ModelError, match="joints but the period has"):
        identify(ideal_period, Model(1))


def test_a_motion_that_tells_nothing_apart_is_refused(ideal_period: SettledPeriod) -> None:
    """With both joints on one small cosine, gravity, inertia and offset cannot be separated."""
    t = 2.0 * np.pi * np.arange(400) / 400
    wave = 0.01 * np.stack((np.cos(t), np.cos(t)))
    with pytest.raises(UnidentifiableError, match="excite more lines"):
        fit_lines(SettledPeriod(400.0, wave, wave, 0.0, np.full(2, 1e-9)))
