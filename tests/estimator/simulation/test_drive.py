"""The motors' torque compared with a lag that is integrated from command to command."""

import numpy as np
import pytest

from hil.estimator.simulation.drive import motor_torque, torque_and_slopes

RATE, STEPS = 400.0, 3
FINE = 40  # instants in a step


def followed(command: np.ndarray, command_to_sample: float, delay: float, lag: float) -> np.ndarray:
    """Return the mean torque over the steps after each sample of the last of ten periods.

    The lag is advanced exactly from instant to instant; delay and `command_to_sample` are whole numbers of instants.
    """
    joints, samples = command.shape
    instant = 1.0 / (RATE * STEPS * FINE)
    held = np.tile(np.repeat(command, STEPS * FINE, axis=1), 10)
    late = np.roll(held, round((delay - command_to_sample) / instant), axis=1)
    if lag > 0.0:
        torque, mean = np.zeros(joints), np.empty_like(late)
        kept = np.exp(-instant / lag)
        for k, wanted in enumerate(late.T):
            mean[:, k] = wanted + (torque - wanted) * (1.0 - kept) * lag / instant
            torque = wanted + (torque - wanted) * kept
        late = mean
    return late[:, -samples * STEPS * FINE :].reshape(joints, samples, STEPS, FINE).mean(axis=3)


@pytest.mark.parametrize("lag", [0.0, 1e-6, 1e-3, 0.02])
@pytest.mark.parametrize("delay", [0.0, -4e-3, 5.125e-3, 0.07])
def test_torque_is_that_of_a_lag_followed_from_command_to_command(lag: float, delay: float) -> None:
    command = np.random.default_rng(1).normal(size=(2, 25))
    given = motor_torque(command, RATE, 2.5e-4, STEPS, delay=delay, lag=lag)
    assert given == pytest.approx(followed(command, 2.5e-4, delay, lag), abs=1e-9)


def test_each_joint_has_its_own_delay() -> None:
    command, delays = np.random.default_rng(3).normal(size=(2, 30)), np.array([1.1e-3, 6e-3])
    both, slopes = torque_and_slopes(command, RATE, 3e-4, STEPS, delay=delays, lag=0.0)
    for joint, delay in enumerate(delays):
        alone = {"delay": delay, "lag": 0.0}
        assert both[joint] == pytest.approx(motor_torque(command[[joint]], RATE, 3e-4, STEPS, **alone)[0])
        # Without a lag, a tiny one acts like a delay.
        late, lag = torque_and_slopes(command[[joint]], RATE, 3e-4, STEPS, **alone)[1][:, 0]
        assert np.allclose(slopes[:, joint], [late, lag]) and np.allclose(late, lag)


def test_torque_slopes_are_those_of_the_torque() -> None:
    command = np.random.default_rng(2).normal(size=(1, 30))
    at = {"delay": 1.1e-3, "lag": 2e-3}
    _, slopes = torque_and_slopes(command, RATE, 3e-4, STEPS, **at)
    for row, name in enumerate(at):
        less, more = (
            motor_torque(command, RATE, 3e-4, STEPS, **{**at, name: at[name] + nudge}) for nudge in (-1e-8, 1e-8)
        )
        assert slopes[row] == pytest.approx((more - less) / 2e-8, rel=1e-4, abs=1e-3)
