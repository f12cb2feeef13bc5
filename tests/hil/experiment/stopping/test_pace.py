"""How often a lowered arm is commanded when its replies are late, and how long they are awaited."""

import pytest

from hil.experiment.stopping.pace import LAST_S, LONGER_S, LONGEST_S, Pace
from hil.plan.silence import BRIDGED_S


@pytest.mark.parametrize("late", [0.001, 0.004, 0.009, 0.016])
@pytest.mark.parametrize("rate", [50, 133, 400])
def test_exchanges_are_as_far_apart_as_the_replies_are_late(late: float, rate: int) -> None:
    pace, are_late = Pace(1 / rate, 0.003), False
    for _ in range(4):
        awaited = pace.patience(0.0, are_late=are_late)
        are_late = late > awaited
        pace.took(min(late, awaited), missed=are_late)
    assert pace.patience(0.0, are_late=False) > late
    if late <= 1 / rate:
        assert pace.every == 1, "every sample can be exchanged"
    else:
        assert late + 0.002 <= pace.every / rate + 1e-9 < late + 0.002 + 1 / rate


def test_late_replies_are_awaited_longer_but_not_for_ever() -> None:
    pace = Pace(0.01, 0.005)
    assert pace.patience(0.02, are_late=True) == LONGEST_S
    assert pace.patience(LAST_S - 0.015, are_late=True) == pytest.approx(0.015)
    assert pace.patience(LAST_S, are_late=True) == pytest.approx(LONGER_S)
    pace.took(0.003, missed=False)
    assert pace.patience(0.025, are_late=False) == pytest.approx(0.003 + LONGER_S) and pace.every == 1


@pytest.mark.parametrize("rate", [20, 100, 133, 250, 400])
def test_lost_replies_are_asked_for_again_soon_unless_no_time_is_left(rate: int) -> None:
    """The last exchange before the limit of 28 ms waits longer: the replies may only be late."""
    pace = Pace(1 / rate, 0.003)
    for unheard, is_last in ((0.0, False), (0.02, False), (0.0249, False), (0.0251, True), (0.05, True)):
        awaited = 0.003 + (LONGER_S if is_last else 0.0)
        assert pace.patience(unheard, are_late=False) == pytest.approx(awaited), unheard
        assert pace.patience(unheard, are_late=False, are_damaged=True) == pytest.approx(0.003), "lost, not late"


@pytest.mark.parametrize("unheard", [0.03, 0.054, BRIDGED_S])
def test_late_replies_are_not_awaited_until_it_is_too_late_to_switch_torque_off(unheard: float) -> None:
    """Torque must be off 100 ms after the latest reply, and switching it off may take 25 ms."""
    ends = unheard + Pace(0.01, 0.005).patience(unheard, are_late=True)
    assert ends <= 0.1 - 0.025 + 1e-9
    assert ends == pytest.approx(min(unheard + LONGEST_S, 0.075)), "but as long as possible"


def test_exchanges_become_rarer_only_if_replies_are_late_again() -> None:
    pace = Pace(0.0025, 0.003)
    pace.took(0.004, missed=False)
    assert pace.every == 1, "a busy computer may be the reason"
    pace.took(0.0024, missed=False)
    pace.took(0.004, missed=False)
    assert pace.every == 3, "6 ms from one exchange to the next, in whole samples"
    pace.took(0.0074, missed=False)
    assert pace.every == 3, "in time"
    pace.took(0.009, missed=False)
    assert pace.every == 5


@pytest.mark.parametrize(("quickest", "awaited"), [(0.004, 0.004), (0.02, 0.009)])
def test_at_low_rates_lost_replies_are_awaited_only_as_long_as_they_usually_take(
    quickest: float, awaited: float
) -> None:
    """Not for the larger part of a sample, as during the experiment."""
    pace = Pace(0.0125, 0.009, quickest)
    assert pace.patience(0.018, are_late=False) == pytest.approx(awaited)
    assert pace.patience(0.0235, are_late=False) == pytest.approx(awaited if quickest < 0.0045 else 0.009 + LONGER_S)
    pace.took(0.0035, missed=False)
    assert pace.patience(0.018, are_late=False) == pytest.approx(max(awaited, 0.0055))


def test_destroyed_replies_are_asked_for_again_after_unequal_times() -> None:
    """Whoever destroys them every 4 ms does not meet every request."""
    pace = Pace(0.0125, 0.009, 0.004)
    awaited = [pace.patience(0.02, are_late=False, are_damaged=True) for _ in range(4)]
    assert awaited == pytest.approx([0.009, 0.004, 0.009, 0.004])


def test_replies_that_have_taken_longer_are_awaited_as_long() -> None:
    pace = Pace(0.02, 0.003)
    pace.took(0.006, missed=False)
    assert pace.patience(0.0, are_late=False) == pytest.approx(0.008)


def test_what_an_unknown_adapter_might_take_is_not_awaited_once_it_is_known_to_be_fast() -> None:
    pace = Pace(0.0167, 0.0177)
    assert pace.patience(0.0, are_late=False) == 0.0177 and pace.patience(0.02, are_late=False) == LONGEST_S
    for seconds in (0.0004, 0.001, 0.0004):
        pace.took(seconds, missed=False)
    assert pace.patience(0.0, are_late=False) == pytest.approx(0.001 + LONGER_S)
    assert pace.patience(0.0, are_late=True) == LONGEST_S
