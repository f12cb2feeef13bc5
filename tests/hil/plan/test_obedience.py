"""A motor that turns against its goals is told from a push by taking its goal away for a moment."""

import numpy as np
import pytest

from hil.plan.obedience import Obedience, Residual

FILTER_S = 0.02


def found_after(gain: float, push: float, velocity: float, interval: float, age: float = 0.05) -> tuple[int, bool]:
    """Whether a joint under 0.4 N m is found, and whether it was tested.

    gain: torque of its motor relative to the commanded one. push: torque on it [N m]. age: how long it has been so [s].
    """
    obedience = Obedience(2)
    commanded = 0.4
    lacking = ((1.0 - gain) * commanded - push) * (1.0 - np.exp(-age / FILTER_S))
    torque, now, found = commanded, 0.0, -1
    obedience.suspect(Residual([0.0, lacking], [0.1, torque], [False, True]), [0.0, velocity], now)
    tested = obedience.is_limp(1)
    fallen = 1.0 - np.exp(-interval / FILTER_S)
    goal = commanded
    while now < 0.1 and found < 0 and (now == 0.0 or obedience.is_limp(1)):
        now += interval
        torque += fallen * (goal - torque)
        lacking += fallen * ((1.0 - gain) * goal - push - lacking)
        found = obedience.look(Residual([0.0, lacking], [0.1, torque], [False, True]), [0.0, velocity], now)
        goal = 0.0 if obedience.is_limp(1) else commanded
    return found, tested


@pytest.mark.parametrize("interval", [0.0025, 0.005, 0.01])
@pytest.mark.parametrize("age", [0.015, 0.05])
def test_a_turned_motor_is_found(interval: float, age: float) -> None:
    assert found_after(-1.0, 0.0, -1.0, interval, age) == (1, True)


@pytest.mark.parametrize("interval", [0.0025, 0.005, 0.01])
def test_a_push_and_a_weak_motor_are_not_turned_motors(interval: float) -> None:
    assert found_after(1.0, -0.8, -1.0, interval) == (-1, True)
    assert found_after(0.45, 0.0, -1.0, interval) == (-1, True)
    assert found_after(2.0, 0.0, 1.0, interval) == (-1, False)


def test_a_joint_that_is_slowed_down_keeps_its_motor() -> None:
    """It may have struck something, whose force ends with the torque that presses the joint against it."""
    assert found_after(-1.0, 0.0, 1.0, 0.005) == (-1, True)
