"""The guard and silent servos: what counts as silence, and which joint it starts with."""

from collections.abc import Callable
from math import nan

import pytest

from hil.config.schema import Config
from hil.drivers.state import State
from hil.errors import SafetyStop
from hil.experiment.guard import Guard
from tests.support.motion import STILL, at

Arm = Callable[..., Config]
ALL_SILENT = STILL._replace(
    current=(nan, nan), velocity=(nan, nan), position=(nan, nan), missing=(True, True), goal_current=(0.0, 0.0)
)
ONE_SILENT = STILL._replace(current=(0.0, nan), velocity=(0.0, nan), position=(-1.57, nan), missing=(False, True))


def stop_after(guard: Guard, first: int, state: State) -> tuple[int, str]:
    """Number of exchanges like `state`, from number `first` on, until the guard stops, and what it says."""
    with pytest.raises(SafetyStop) as stop:
        for number in range(first, first + 100):
            guard.look(at(number, state))
    return number - first + 1, str(stop.value)


def test_a_guard_that_knows_no_patience_takes_a_stall_for_no_silence(arm: Arm) -> None:
    guard = Guard(arm())
    guard.look(at(0, STILL))
    count, said = stop_after(guard, 8, ONE_SILENT)  # after 20 ms without any exchange
    assert count == 6 and "18 ms of it because this computer was busy" in said


@pytest.mark.parametrize(("others_answer", "said"), [(True, "while other servos answer allows 28"), (False, "60")])
def test_silence_of_all_may_be_that_of_one_that_hides_the_others(arm: Arm, others_answer: bool, said: str) -> None:
    guard = Guard(arm(), lowers_since=0.0)
    guard.look(at(0, STILL))
    if others_answer:
        guard.others_answer()
    assert said in stop_after(guard, 1, ALL_SILENT)[1]


def test_silence_of_all_is_their_own_again_once_one_was_heard(arm: Arm) -> None:
    guard = Guard(arm(), lowers_since=0.0)
    guard.look(at(0, STILL))
    guard.others_answer()
    guard.look(at(1, ONE_SILENT))
    guard.look(at(2, STILL))
    assert "lowering the arm allows 60 ms" in stop_after(guard, 3, ALL_SILENT)[1]
