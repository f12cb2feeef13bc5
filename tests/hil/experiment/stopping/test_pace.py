"""How often a lowered arm is commanded when its replies are late, and how long they are awaited."""

import pytest

from hil.experiment.stopping.pace import LAST_S, LONGER_S, LONGEST_S, Pace


@pytest.mark.parametrize("late", [0.001, 0.004, 0.009, 0.016])
@pytest.mark.parametrize("rate", [50, 133, 400])
def test_exchanges_are_as_far_apart_as_the_replies_are_late(late: float, rate: int) -> None:
    pace = Pace(1 / rate, 0.003, is_blind=False)
    for _ in range(3):
        awaited = pace.patience(0.0)
        assert awaited >= 0.003
        pace.took(min(late, awaited), missed=late > awaited)
    assert pace.patience(0.0) > late
    assert late <= pace.every / rate < late + 0.002 + 1 / rate or pace.every == 1


def test_after_missing_replies_the_next_ones_are_awaited_longer_but_not_for_ever() -> None:
    pace = Pace(0.01, 0.005, is_blind=True)
    assert pace.patience(0.02) == LONGEST_S
    assert pace.patience(LAST_S - 0.015) == pytest.approx(0.015)
    assert pace.patience(LAST_S) == pytest.approx(0.005)
    pace.took(0.005, missed=False)
    assert pace.patience(0.0) == pytest.approx(0.005 + LONGER_S) and pace.every == 1
