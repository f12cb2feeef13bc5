"""How many foreign values, in which time, prove that another program writes to a servo."""

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.read_back import Overruled, ReadBack
from hil.drivers.sync_read import Answer, Span

XM430 = load_control_table("XM430-W350")
GOALS = Span.of([XM430] * 2, ("Bus Watchdog", "Goal PWM", "Goal Current"))
MODES = Span.of([XM430] * 2, ("Drive Mode", "Operating Mode"))
OURS, FOREIGN = 40, -7
MODE, OTHER_MODE = 0, 3
SENT = [[10, 20], [30, OURS]]
LONG_AGO = 55
"""A goal older than the recent ones."""


def read_back() -> ReadBack:
    return ReadBack((1, 2), GOALS, MODES, [MODE, MODE], fast=False)


def reads_modes(back: ReadBack) -> bool:
    return back.read is back.reads[True]


def look(back: ReadBack, now: float, *, goal: int = OURS, mode: int = MODE) -> Overruled | None:
    """Read back once: the second servo holds this goal and mode."""
    held = (MODE, mode) if reads_modes(back) else (SENT[-1][0], goal)
    servos: list[Answer] = [(0, each) for each in held]
    return back.look(servos, [[LONG_AGO, 56], *SENT * 2], now)


@pytest.mark.parametrize(("goal", "proof"), [(FOREIGN, 2), (LONG_AGO, 3), (0, 3)])
def test_the_second_foreign_goal_is_proof_the_third_of_one_that_lost_writes_may_leave(goal: int, proof: int) -> None:
    back = read_back()
    seen, now, found = 0, 0.0, None
    while found is None:
        seen += not reads_modes(back)
        now += 0.01
        found = look(back, now, goal=goal)
    assert seen == proof and found == Overruled(1, "Goal Current", goal, OURS)


def test_the_second_foreign_mode_is_proof() -> None:
    back = read_back()
    seen, now, found = 0, 0.0, None
    while found is None:
        seen += reads_modes(back)
        now += 0.01
        found = look(back, now, mode=OTHER_MODE)
    assert seen == 2 and found == Overruled(1, "Operating Mode", OTHER_MODE, MODE)


@pytest.mark.parametrize(
    ("goal", "apart", "is_proof"), [(FOREIGN, 0.9, True), (FOREIGN, 1.1, False), (0, 0.3, True), (0, 0.7, False)]
)
def test_sightings_must_lie_within_a_second(goal: int, apart: float, is_proof: bool) -> None:
    """Between two foreign goals, this program's own are read."""
    back = read_back()
    found = []
    for number in range(8):
        while reads_modes(back):
            look(back, number * apart)
        found.append(look(back, number * apart, goal=goal))
    assert any(found) is is_proof


def test_one_sighting_short_of_proof_the_same_registers_are_read_again() -> None:
    back = read_back()
    assert reads_modes(back)
    look(back, 0.0, mode=OTHER_MODE)
    assert reads_modes(back)
    for goal, sightings in ((FOREIGN, 1), (LONG_AGO, 2)):
        back, seen, now = read_back(), 0, 0.0
        while seen < sightings:
            seen += not reads_modes(back)
            now += 0.01
            look(back, now, goal=goal)
        assert not reads_modes(back)


def test_after_a_sighting_every_cycle_is_followed_by_a_read_back_for_a_while() -> None:
    back = read_back()
    look(back, 1.0)
    assert 1.0 < back.due < 1.03
    while reads_modes(back):
        look(back, 1.0)
    look(back, 1.0, goal=FOREIGN)
    assert back.due == 1.0 and back.doubts_until == pytest.approx(1.3)
    look(back, 1.29)
    assert back.due == 1.29
    look(back, 1.31)
    assert back.due > 1.31


def test_a_refusal_or_a_missing_answer_shows_nothing() -> None:
    back = read_back()
    for number in range(50):
        assert back.look([None, (FOREIGN,)], SENT, 0.01 * number) is None
    assert back.doubts_until < 0.0


def test_a_goal_that_was_sent_recently_or_to_the_neighbour_is_not_foreign() -> None:
    back = read_back()
    for number in range(50):
        for goal in (10, 20, 30):
            assert look(back, 0.01 * number, goal=goal) is None
    assert back.doubts_until < 0.0


def test_the_longest_read_back_fades() -> None:
    back = read_back()
    back.took(0.01)
    back.took(0.001)
    assert back.longest == pytest.approx(0.0098)
    back.took(0.02)
    assert back.longest == 0.02


def test_one_or_two_read_backs_of_goals_lie_between_two_of_modes() -> None:
    back, counts, goals = read_back(), set(), 0
    for number in range(200):
        if reads_modes(back):
            counts.add(goals)
            goals = 0
        else:
            goals += 1
        look(back, 0.01 * number)
    assert counts == {0, 1, 2}, "none before the first"
