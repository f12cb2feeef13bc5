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


def falling(lacking: list[float], torque: list[float]) -> tuple[int, Obedience]:
    """The joint that is found in a test of one that speeds up, after these torques at intervals of 5 ms [N m]."""
    obedience, found = Obedience(1), -1
    assert obedience.question(0, 0.0)
    for number, values in enumerate(zip(lacking, torque, strict=True), 1):
        found = obedience.look(Residual(*([each] for each in values), [False]), [-1.0], 5e-3 * number)
    return found, obedience


OWN = [0.4, 0.32, 0.25, 0.2, 0.16]


def test_what_falls_otherwise_than_the_motors_own_torque_is_something_else() -> None:
    found, obedience = falling([2.0 * each for each in OWN], OWN)
    assert found == 0, "a reversed motor"
    found, obedience = falling([0.6, 0.6, 0.6, 0.3, 0.15], OWN)
    assert found == -1 and not obedience.is_limp(0) and obedience.question(0, 0.03), "a push that has just ended"
    assert falling([5.0 * each for each in OWN], OWN)[0] == -1, "a motor cannot do more than turn round"
    found, obedience = falling([0.6] * 5, OWN)
    assert found == -1 and obedience.is_pushed(0) and obedience.question(0, 0.03) and not obedience.is_limp(0)


def test_a_joint_that_runs_away_after_an_inconclusive_test_is_blamed() -> None:
    """Its motor may have become reversed right before the test."""
    found, obedience = falling(OWN, OWN)
    assert found == -1 and not obedience.question(0, 0.03)
    assert obedience.question(0, 0.2)


def test_what_falls_unevenly_again_and_again_is_the_motors_own() -> None:
    obedience, found, now = Obedience(1), -1, 0.0
    for _ in range(3):
        assert found == -1
        obedience.question(0, now)
        for values in zip([0.6, 0.6, 0.6, 0.3, 0.1], OWN, strict=True):
            now += 5e-3
            found = obedience.look(Residual(*([each] for each in values), [False]), [-1.0], now)
        now += 0.02
    assert found == 0
