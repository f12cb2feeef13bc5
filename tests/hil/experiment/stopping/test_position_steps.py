"""A reading that steps while an arm is lowered does not move the arm."""

import numpy as np
import pytest

from hil.drivers.state import State
from hil.experiment.stopping.position_steps import MOST_STEPS, PositionSteps

DT = 0.01


def state(
    index: int, position: tuple[float, ...], velocity: float, missing: tuple[bool, ...] = (False, False)
) -> State:
    at, none = DT * index, (0.0, 0.0)
    return State(at, at + 0.001, none, none, (velocity, 0.0), position, (0, 0), missing)


def corrected(steps: dict[int, float], count: int = 30) -> np.ndarray:
    """Positions of a joint at 0.6 rad/s with steps of its reading at these samples [rad]; the other stands still."""
    rides = PositionSteps(state(0, (0.0, 1.0), 0.6))
    found, off = [], 0.0
    for index in range(1, count):
        off += steps.get(index, 0.0)
        found.append(rides.corrected(state(index, (0.6 * DT * index + off, 1.0), 0.6)).position)
    assert all(other == 1.0 for _, other in found)
    return np.array(found)[:, 0]


@pytest.mark.parametrize("step", [-2.0, -0.1, 0.06, 0.3])
@pytest.mark.parametrize("lasts", [1, 2, 15, 100])
def test_a_step_is_ridden_over_and_its_end_too(step: float, lasts: int) -> None:
    true = 0.6 * DT * np.arange(1, 30)
    found = corrected({10: step, 10 + lasts: -step})
    np.testing.assert_allclose(found, true, atol=1e-9)


def test_motion_is_no_step() -> None:
    rides = PositionSteps(state(0, (0.0, 0.0), 0.0))
    for index in range(1, 40):
        velocity = 8.0 * np.sin(0.5 * index)
        moving = state(index, (float(-16.0 * DT * np.cos(0.5 * index) + 16.0 * DT), 0.0), float(velocity))
        assert rides.corrected(moving) is moving


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    ("index", "velocity", "plausible", "step"),
    [
        (1, 0.0, (0.048, -0.048), (0.052, -0.052)),  # a joint at rest may be pushed by 200 rad/s^2 for 10 ms,
        (2, 0.0, (0.078, -0.078), (0.082, -0.082)),  # or for 20 ms, if a reply is missing
        (1, 8.0, (0.0, 0.08, 0.128, -0.048), (0.132, -0.052)),  # it moves as fast as its velocity says, or not at all
    ],
)
def test_only_what_the_velocity_and_a_large_acceleration_cannot_explain_is_a_step(
    direction: int, index: int, velocity: float, plausible: tuple[float, ...], step: tuple[float, ...]
) -> None:
    def after(reading: float) -> float:
        rides = PositionSteps(state(0, (0.3, 1.0), direction * velocity))
        read = state(index, (0.3 + direction * reading, 1.0), direction * velocity)
        return direction * (rides.corrected(read).position[0] - 0.3)

    for reading in plausible:
        assert after(reading) == pytest.approx(reading), "believed"
    for reading in step:
        assert after(reading) == pytest.approx(velocity * DT * index), "corrected to where the velocity leads"


def test_three_false_readings_are_corrected_and_a_fourth_is_believed() -> None:
    """Each steps away and back again."""
    times, off = (4, 9, 14, 19), 0.3
    found = corrected({index + back: -off if back else off for index in times for back in (0, 1)})
    true = 0.6 * DT * np.arange(1, 30)
    true[times[-1] - 1] += off
    np.testing.assert_allclose(found, true, atol=1e-9)


def test_a_reading_that_steps_again_and_again_is_believed() -> None:
    found = corrected({index: 0.3 * (-1) ** index for index in range(3, 3 + MOST_STEPS + 3)})
    assert np.abs(np.diff(found)).max() > 0.25


def test_a_missing_reply_is_left_alone() -> None:
    rides = PositionSteps(state(0, (0.0, 1.0), 0.0))
    nan = float("nan")
    unheard = state(1, (nan, 1.0), nan, (True, False))
    assert rides.corrected(unheard) is unheard
    assert rides.corrected(state(2, (0.5, 1.0), 0.0)).position[0] == pytest.approx(0.0)
