"""How many foreign values, in which time, prove that another program writes to a servo."""

import itertools
import math

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.others.read_back import LOST_OF, Overruled, ReadBack
from hil.drivers.packet import ALERT, StatusError
from hil.drivers.sync_read import Answer, Span

XM430 = load_control_table("XM430-W350")
GOALS = Span.of([XM430] * 2, ("Bus Watchdog", "Goal PWM", "Goal Current"))
MODES = Span.of([XM430] * 2, ("Drive Mode", "Operating Mode"))
TORQUE = Span.of([XM430] * 2, ("Torque Enable", "Hardware Error Status"))
OURS, FOREIGN = 40, -7
MODE, OTHER_MODE = 0, 3
WATCHDOG, LIMIT = 4, 885
SENT = [[10, 20], [30, OURS]]
LONG_AGO = 55
"""A goal older than the recent ones."""


def read_back() -> ReadBack:
    return ReadBack((1, 2), GOALS, MODES, [(MODE,), (MODE,)], TORQUE, [(LIMIT,)] * 2, interval=0.0, fast=False)


def reads_modes(back: ReadBack) -> bool:
    return back.read is back.reads[True]


def look(back: ReadBack, now: float, *, goal: int = OURS, mode: int = MODE, limit: int = LIMIT) -> Overruled | None:
    """Read back once: the second servo holds this goal, mode and limit."""
    goals: list[Answer] = [(0, WATCHDOG, LIMIT, SENT[-1][0]), (0, WATCHDOG, limit, goal)]
    servos: list[Answer] = [(0, MODE), (0, mode)] if reads_modes(back) else goals
    return back.look(servos, [[LONG_AGO, 56], *SENT * 2], now)


def proof_of(back: ReadBack, *, of_modes: bool = False, **held: int) -> tuple[int, Overruled]:
    """Read back until something is proof; return how many read-backs of that kind it took, and what was found."""
    seen, now, found = 0, 0.0, None
    while found is None:
        seen += reads_modes(back) == of_modes
        now += 0.01
        found = look(back, now, **held)
    return seen, found


@pytest.mark.parametrize(("goal", "proof"), [(FOREIGN, 2), (LONG_AGO, 3), (0, 3)])
def test_the_second_foreign_goal_is_proof_the_third_of_one_that_lost_writes_may_leave(goal: int, proof: int) -> None:
    assert proof_of(read_back(), goal=goal) == (proof, Overruled(1, "Goal Current", goal, OURS))


@pytest.mark.parametrize("register", ["Drive Mode", "Operating Mode", "Homing Offset"])
def test_any_setting_that_changes_what_goals_and_angles_mean_is_compared(register: str) -> None:
    names = ("Drive Mode", "Operating Mode", "Homing Offset")
    spans = GOALS, Span.of([XM430] * 2, ("ID", *names)), [(0, 0, -84), (4, 3, 0)], TORQUE, [(LIMIT,)] * 2
    back = ReadBack((1, 2), *spans, interval=0.0, fast=False)
    held = {name: value + 7 * (name == register) for name, value in zip(names, (4, 3, 0), strict=True)}
    for now, found in ((0.0, False), (0.01, True)):
        assert reads_modes(back)
        told = back.look([(0, 1, 0, 0, -84), (0, 2, *held.values())], SENT, now)
        assert told == (Overruled(1, register, held[register], held[register] - 7) if found else None)


@pytest.mark.parametrize(("apart", "proof"), [(0.001, 11), (0.004, 4), (0.005, 3)])
def test_a_goal_that_lost_writes_may_leave_is_no_proof_before_the_status_was_read(apart: float, proof: int) -> None:
    back = read_back()
    look(back, 0.0)
    assert not reads_modes(back)
    found = [look(back, 1.0 + 1.001 * apart * number, goal=LONG_AGO) for number in range(proof)]
    assert not any(found[:-1]) and found[-1]


def test_different_goals_of_ours_are_what_lost_writes_leave() -> None:
    back, now = read_back(), 0.0
    for goal in (LONG_AGO, 56, 0) * 2:
        while reads_modes(back):
            look(back, now)
        now += 0.1
        assert look(back, now, goal=goal) is None
    assert look(back, now + 0.1, goal=LONG_AGO)


def test_the_second_foreign_mode_is_proof() -> None:
    found = Overruled(1, "Operating Mode", OTHER_MODE, MODE)
    assert proof_of(read_back(), of_modes=True, mode=OTHER_MODE) == (2, found)


@pytest.mark.parametrize("limit", [0, LIMIT - 1])
def test_the_second_foreign_limit_is_proof_although_the_goals_are_ours(limit: int) -> None:
    back = read_back()
    assert proof_of(back, limit=limit) == (2, Overruled(1, "Goal PWM", limit, LIMIT))
    assert back.is_unexpected


@pytest.mark.parametrize(
    ("goal", "apart", "is_proof"),
    [(FOREIGN, 0.9, True), (FOREIGN, 4.9, True), (FOREIGN, 5.1, False), (0, 0.3, True), (0, 0.7, False)],
)
def test_sightings_must_not_lie_too_far_apart(goal: int, apart: float, is_proof: bool) -> None:
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


def test_a_sighting_raises_doubts_for_a_while() -> None:
    back = read_back()
    look(back, 1.0)
    assert not reads_modes(back)
    look(back, 1.01, goal=FOREIGN)
    look(back, 1.02)
    assert back.doubts_until == pytest.approx(1.31)


@pytest.mark.parametrize(("goal", "is_unexpected"), [(OURS, False), (20, True), (FOREIGN, True)])
def test_an_earlier_goal_than_the_latest_is_unexpected_though_not_foreign(goal: int, is_unexpected: bool) -> None:
    back = read_back()
    assert not back.is_unexpected
    look(back, 1.0)
    for now in (1.001, 1.002):
        look(back, now, goal=goal)
        assert back.is_unexpected is is_unexpected
    look(back, 1.003)
    assert not back.is_unexpected


@pytest.mark.parametrize("error", [FOREIGN, SENT[0][1]])
def test_a_refusal_or_a_missing_answer_shows_nothing(error: int) -> None:
    """The number of an error may equal a goal that was sent before."""
    back = read_back()
    for number in range(50):
        assert back.look([None, (error,)], SENT, 0.01 * number) is None
        assert not back.is_unexpected
    assert back.doubts_until < 0.0 and back.lost is None


@pytest.mark.parametrize(("error", "shows"), [(ALERT, True), (StatusError.ACCESS, False), (ALERT | 7, False)])
def test_values_with_an_error_are_no_read_back(error: int, shows: bool) -> None:
    back = read_back()
    look(back, 1.0)
    assert back.look([None, (error, WATCHDOG, LIMIT, FOREIGN)], SENT, 1.001) is None
    assert back.is_unexpected is shows


@pytest.mark.parametrize("collided", [False, True])
def test_goals_that_a_late_reply_may_have_destroyed_are_not_counted_as_missed(collided: bool) -> None:
    back, now = read_back(), 1.0
    for _ in range(2 * LOST_OF):
        now += 0.01
        goals: list[Answer] = [(0, WATCHDOG, LIMIT, goal) for goal in (SENT[-1][0], SENT[-2][1])]
        servos: list[Answer] = [(0, MODE)] * 2 if reads_modes(back) else goals
        said = {"collided": True} if collided else {}
        assert back.look(servos, SENT, now, **said) is None
    assert (back.lost is None) is collided and back.is_unexpected


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


@pytest.mark.parametrize("apart", [0.001, 0.0025, 0.01])
def test_modes_are_read_every_25_ms_at_random_and_goals_otherwise(apart: float) -> None:
    back, times = read_back(), []
    for number in range(round(25 / apart)):
        if reads_modes(back):
            times.append(apart * number)
        look(back, apart * number)
    between = [after - before for before, after in itertools.pairwise(times)]
    assert min(between) >= 0.0125 and max(between) < 0.0375 + 2.001 * apart
    assert sum(between) / len(between) == pytest.approx(0.025 + 1.5 * apart, rel=0.05)


def test_at_least_one_read_back_of_goals_follows_each_of_modes_and_four_in_doubt() -> None:
    back = read_back()
    for is_in_doubt, least in ((False, 1), (True, 4)):
        counts, goals = set(), 99
        for number in range(100):
            now = number + 0.1
            back.doubts_until = now + 1.0 if is_in_doubt else 0.0
            if reads_modes(back):
                counts.add(goals)
                goals = 0
            else:
                goals += 1
            look(back, now)
        assert counts == {least, 99}


@pytest.mark.parametrize(
    ("delay", "in_doubt", "least", "most"),
    [(0.0005, False, 0.025, 0.05), (0.002, False, 0.0375, 0.075), (0.002, True, 0.01, 0.02)],
)
def test_the_next_overdue_read_back_follows_the_sooner_the_shorter_the_delay(
    delay: float, in_doubt: bool, least: float, most: float
) -> None:
    """After up to 100 times the delay, 10 times if another program is suspected, and at most 75 ms: at random, so that
    no other program escapes by its rhythm.
    """
    back, pauses = read_back(), []
    back.doubts_until = 1e3 if in_doubt else -math.inf
    for now in range(100):
        back.delayed(float(now), delay, alone=False)
        pauses.append(back.overdue_at - now)
    assert least <= min(pauses) < 1.1 * least and 0.95 * most < max(pauses) <= most
    back.delayed(100.0, 0.0, alone=False)
    assert back.overdue_at == pytest.approx(100.075), "without a delay it is not random"


def test_the_shortest_read_is_that_of_one_goal_also_of_an_arm_with_one_servo() -> None:
    one = ReadBack((1,), GOALS, MODES, [(MODE,)], TORQUE, [(LIMIT,)], interval=0.0, fast=False)
    assert one.shortest.reply_size == one.reads[0].reply_size and one.alone.reply_size == one.reads[1].reply_size


@pytest.mark.parametrize("is_silent", [False, True])
def test_modes_are_confirmed_by_the_answers_of_all_servos(is_silent: bool) -> None:
    back = read_back()
    assert back.modes_seen_at == -math.inf and reads_modes(back)
    back.look([(0, MODE), None if is_silent else (0, MODE)], SENT, 1.0)
    assert back.modes_seen_at == (-math.inf if is_silent else 1.0)
    while not reads_modes(back):
        look(back, 2.0)
    back.look([(0, MODE), (0, OTHER_MODE)], SENT, 3.0)
    assert back.modes_seen_at == (-math.inf if is_silent else 1.0)


@pytest.mark.parametrize("watches_torque", [False, True])
def test_torque_is_read_back_ten_times_a_second_if_no_status_shows_it(watches_torque: bool) -> None:
    back = ReadBack(
        *((1, 2), GOALS, MODES, [(MODE,)] * 2, TORQUE, [(LIMIT,)] * 2),
        watches_torque=watches_torque,
        interval=0.0,
        fast=False,
    )
    times = []
    for number in range(2000):
        now = 0.005 * number
        servos: dict[int, list[Answer]] = {
            **{0: [(0, WATCHDOG, LIMIT, own) for own in SENT[-1]], 1: [(0, MODE)] * 2},
            2: [(0, 1, 0)] * 2,
        }
        if back.kind == 2:
            times.append(now)
        back.look(servos[back.kind], SENT, now)
    assert bool(times) is watches_torque
    if watches_torque:
        between = [after - before for before, after in itertools.pairwise(times)]
        assert times[0] < 0.05 and min(between) >= 0.05 and max(between) < 0.17
        assert sum(between) / len(between) == pytest.approx(0.11, rel=0.1)


def test_a_lost_read_back_is_repeated_once_in_5_ms_if_that_takes_less_than_half_of_a_short_cycle() -> None:
    def may(interval: float, *times: float, takes: float = 0.001) -> list[bool]:
        spans = (1, 2), GOALS, MODES, [(MODE,)] * 2, TORQUE, [(LIMIT,)] * 2
        back = ReadBack(*spans, interval=interval, fast=False)
        return [back.may_repeat(now, takes) for now in times]

    assert may(0.004, 1.0, 1.0049, 1.0051, 1.0099) == [True, False, True, False]
    assert may(0.004, 0.0, takes=0.0019) == [True] and may(0.004, 0.0, takes=0.0021) == [False]
    assert may(0.005, 0.0) == [True] and may(0.0051, 0.0) == [False], (
        "a delay of a long cycle leaves the arm unobserved"
    )


def test_a_read_back_is_overdue_75_ms_after_the_first_one_that_was_left_out() -> None:
    back = read_back()
    assert back.overdue_at == math.inf
    back.postponed(1.0)
    back.postponed(1.01)
    assert back.overdue_at == pytest.approx(1.075)
    back.delayed(1.08, 0.0, alone=True)
    assert back.overdue_at == pytest.approx(1.075 + 0.075 / 2), "if only one of two was read, the other soon follows"
    back.delayed(1.09, 0.0, alone=False)
    assert back.overdue_at == pytest.approx(1.09 + 0.075)
    back.delayed(1.0, 0.0, alone=True)
    assert back.overdue_at == pytest.approx(1.0 + 0.075), "but never later than after the usual pause"


@pytest.mark.parametrize("between", ["nothing", "silence", "collisions"])
def test_only_read_backs_that_show_a_goal_count_when_three_of_six_are_missed(between: str) -> None:
    """Between two missed goals there are two read-backs, which show nothing or the latest goals."""
    back, now = read_back(), 1.0
    look(back, now)
    own: list[Answer] = [(0, WATCHDOG, LIMIT, goal) for goal in SENT[-1]]
    late: Answer = (0, WATCHDOG, LIMIT, SENT[-2][1])
    for _ in range(3):
        for servos, collided in (
            ([own[0], late], False),
            *2 * [([own[0], None] if between == "silence" else own, between == "collisions")],
        ):
            now += 1e-4
            assert not reads_modes(back)
            back.look(servos, SENT, now, collided=collided)
    assert (back.lost is not None) is (between != "nothing")


@pytest.mark.parametrize(("limit", "goals"), [(LIMIT, (FOREIGN, FOREIGN)), (LIMIT - 1, (SENT[-1][0], OURS))])
def test_a_program_that_writes_to_every_servo_is_found_as_well(limit: int, goals: tuple[int, int]) -> None:
    back = read_back()
    look(back, 1.0)
    servos: list[Answer] = [(0, WATCHDOG, limit, goal) for goal in goals]
    found = [back.look(servos, SENT, 1.0 + 1e-4 * number) for number in range(2)]
    assert found[0] is None and found[1] is not None and found[1].place == 0


@pytest.mark.parametrize(("goal", "goals"), [(OURS, 0), (LONG_AGO, 3)])
def test_modes_that_are_due_are_read_between_sightings_that_are_far_from_proof(goal: int, goals: int) -> None:
    """Four read-backs of goals come before them, including the one that raised the doubts; without doubts, one."""
    back = read_back()
    look(back, 0.0)
    look(back, 1.0, goal=goal)
    count = 0
    while not reads_modes(back):
        count += 1
        look(back, 1.0 + 1e-3 * count)
    assert count == goals
