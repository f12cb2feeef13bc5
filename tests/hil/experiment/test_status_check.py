"""Status registers of the servos: every fault is detected, and normal values are accepted."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from hil.config.schema import Config, load_config
from hil.drivers.state import Status
from hil.errors import Cause
from hil.experiment.status_check import StatusCheck
from tests.support.edits import with_second_servo
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
FINE = Status(watchdog=4, goal=0.1, tick=1.0, torque=True, hardware_error=0)


@pytest.mark.parametrize(
    ("change", "cause", "said"),
    [
        ({"torque": False}, Cause.TORQUE_OFF, "Torque Enable reads 0"),
        ({"hardware_error": 32}, Cause.ALERT, "overload"),
        ({"watchdog": 255}, Cause.WATCHDOG, "received nothing for 80 ms"),
        ({"watchdog": 0}, Cause.WATCHDOG, "no longer protected: its Bus Watchdog reads 0 but was set to 4"),
        ({"watchdog": 5}, Cause.WATCHDOG, "stops by itself later than intended: its Bus Watchdog reads 5"),
        ({"watchdog": 1}, Cause.WATCHDOG, "stops by itself earlier than intended"),
    ],
)
def test_what_one_status_shows(arm: Arm, change: dict[str, object], cause: Cause, said: str) -> None:
    wrong = StatusCheck(arm()).look(1, FINE._replace(**change), 0.1, 1.0)
    assert wrong is not None and wrong[0] is cause and said in wrong[1]


@pytest.mark.parametrize(("gap", "said"), [(0.01, "another program"), (0.07, "the computer kept this program waiting")])
def test_why_a_watchdog_tripped_depends_on_how_long_nothing_was_sent(arm: Arm, gap: float, said: str) -> None:
    check = StatusCheck(arm())
    check.longest_gap = gap
    wrong = check.look(1, FINE._replace(watchdog=255), 0.1, 1.0)
    assert wrong is not None and said in wrong[1] and ("another program" in wrong[1]) == (gap < 0.05)
    unknown = StatusCheck(arm()).look(1, FINE._replace(watchdog=255), 0.1, 1.0)
    assert unknown is not None and "another program" in unknown[1]


def test_what_a_short_status_leaves_out_is_not_wrong(arm: Arm) -> None:
    assert StatusCheck(arm()).look(0, FINE._replace(torque=None, hardware_error=None), 0.1, 1.0) is None


def test_a_servo_without_watchdog_where_the_user_accepts_it(arm: Arm) -> None:
    accepted = arm(("[experiment]\n", "[safety]\nallow_no_watchdog = true\n\n[experiment]\n"))
    assert StatusCheck(accepted).look(0, FINE._replace(watchdog=0), 0.1, 1.0) is None
    assert StatusCheck(accepted).look(0, FINE._replace(watchdog=255), 0.1, 1.0) is not None


def test_a_goal_may_get_lost_once_but_not_twice_in_a_row(arm: Arm) -> None:
    check = StatusCheck(arm())
    lost = FINE._replace(goal=0.05)
    assert check.look(0, lost, 0.1, 1.0) is None
    assert check.look(1, lost, 0.1, 1.0) is None, "each joint by itself"
    assert check.look(0, FINE, 0.1, 1.0) is None
    assert check.look(0, lost, 0.1, 1.0) is None
    wrong = check.look(0, lost, 0.1, 1.0)
    assert wrong is not None and wrong[0] is Cause.GOALS_LOST and "holds 0.050 A but 0.100 A was sent" in wrong[1]


@pytest.mark.parametrize(
    ("held", "pauses", "cause"),
    [((0.06, 0.07), 0, Cause.STALE), ((0.06, 0.06), 0, Cause.GOALS_LOST), ((0.06, 0.08), 1, Cause.GOALS_LOST)],
)
def test_a_servo_that_holds_the_goal_it_seemed_to_have_missed_answers_a_cycle_late(
    arm: Arm, held: Sequence[float], pauses: int, cause: Cause
) -> None:
    """After a pause the missed goal is not that of the cycle before, so goals may get lost now and then."""
    check = StatusCheck(arm())
    goals = iter((0.06, 0.07, 0.08, 0.09))
    for holds, before in zip(held, (2, 1 + pauses), strict=True):
        for _ in range(before):
            goal = next(goals)
            check.sent((goal, 0.0))
        wrong = check.look(0, FINE._replace(goal=holds), goal, 1.0)
    assert wrong is not None and wrong[0] is cause and ("a cycle late" in wrong[1]) == (cause is Cause.STALE)


@pytest.mark.parametrize(("held", "late"), [((0.03, 0.04), 4), ((0.03, 0.03), 0), ((0.04, 0.03), 0)])
def test_a_goal_held_later_than_it_was_sent_shows_how_late_replies_are(
    arm: Arm, held: Sequence[float], late: int
) -> None:
    check = StatusCheck(arm())
    for number, goal in enumerate((0.03, 0.04, 0.05, 0.06, 0.07, 0.08)):
        check.sent((goal, 0.0))
        if number >= 4:
            wrong = check.look(0, FINE._replace(goal=held[number - 4], tick=1.0 + number), goal, 1.0 + number)
    assert wrong is not None and (f"{late} cycles late" in wrong[1]) == (wrong[0] is Cause.STALE) == bool(late)


@pytest.mark.parametrize(
    ("ticks", "cause"), [((1.0, 1.0), Cause.STALE), ((1.01, 0.99), Cause.STALE), ((1.01, 1.02), Cause.GOALS_LOST)]
)
def test_replies_that_are_old_by_the_servos_clock_show_no_lost_goals(
    arm: Arm, ticks: Sequence[float], cause: Cause
) -> None:
    check = StatusCheck(arm())
    for number in range(4):
        assert check.look(0, FINE._replace(tick=0.97 + 0.01 * number), 0.1, 0.97 + 0.01 * number) is None
    for number, tick in enumerate(ticks):
        wrong = check.look(0, FINE._replace(goal=0.05, tick=tick), 0.1, 1.01 + 0.01 * number)
    assert wrong is not None and wrong[0] is cause and ("stale" in wrong[1]) == (cause is Cause.STALE)


@pytest.mark.parametrize(
    ("held", "is_foreign"),
    [((0.404, 0.404), True), ((-0.1, -0.11), True), ((0.07, 0.404), True), ((0.07, 0.07), False)],
)
def test_goals_that_were_never_sent_are_not_lost_goals(arm: Arm, held: Sequence[float], is_foreign: bool) -> None:
    """A servo that misses writes holds an older goal of this program."""
    check = StatusCheck(arm())
    for goal in (0.06, 0.07, 0.08, 0.09):
        check.sent((0.0, goal))
    check.look(1, FINE._replace(goal=0.09), 0.09, 1.0)
    found = None
    for goal, other in zip((0.1, 0.11), held, strict=True):
        check.sent((0.0, goal))
        found = check.look(1, FINE._replace(goal=other), goal, 1.0)
        assert check.other_goal(1) == other
    assert found is not None and found[0] is Cause.GOALS_LOST
    assert ("this program never sent" in found[1]) == is_foreign
    assert ("Goals are being lost" in found[1]) != is_foreign


@pytest.mark.parametrize(("between_s", "held", "is_found"), [(4.0, -0.1, True), (6.0, -0.1, False), (1.0, 0.05, False)])
def test_goals_that_are_changed_now_and_then_are_found_by_the_third(
    arm: Arm, between_s: float, held: float, is_found: bool
) -> None:
    """A goal of this program that is still held may be due to lost packets."""
    check = StatusCheck(arm())
    found = []
    for time in range(3):
        for goal, read in ((0.05, 0.05), (0.1, held), (0.1, 0.1)):
            check.sent((goal, goal))
            found.append(check.look(0, FINE._replace(goal=read, tick=time * between_s), goal, time * between_s))
    assert [each is not None for each in found] == [False] * 7 + [is_found, False]
    if found[-2] is not None:
        assert found[-2][0] is Cause.GOALS_LOST and "this program never sent" in found[-2][1]


def readings(check: StatusCheck, clock: Callable[[float], float], until: float) -> tuple[float, str] | None:
    """Readings every 35 ms; returns when stale replies are detected, and the message."""
    for index in range(int(until / 0.035)):
        now = 0.035 * index
        wrong = check.look_at_clock(0, clock(now), now)
        if wrong is not None:
            assert wrong[0] is Cause.STALE
            return now, wrong[1]
    return None


@pytest.mark.parametrize("ppm", [-5000, 0, 5000])
def test_a_clock_that_drifts_and_wraps_is_fine(arm: Arm, ppm: float) -> None:
    def clock(now: float) -> float:
        return int(1e3 * ((30.0 + now * (1 + 1e-6 * ppm)) % 32.768)) * 1e-3

    assert readings(StatusCheck(arm()), clock, 70.0) is None


def test_requests_that_leave_late_now_and_then_are_fine(arm: Arm) -> None:
    assert readings(StatusCheck(arm()), lambda now: now + (0.02 if 0.5 < now % 1 < 0.6 else 0.0), 10.0) is None


def test_replies_that_are_held_up_are_seen_in_two_readings(arm: Arm) -> None:
    found = readings(StatusCheck(arm()), lambda now: now - (0.008 if now > 1.0 else 0.0), 3.0)
    assert found is not None and 1.0 < found[0] < 1.08 and "8 ms off" in found[1]


def test_a_reboot_is_seen_by_the_servos_clock(arm: Arm) -> None:
    found = readings(StatusCheck(arm()), lambda now: now + 7.0 if now < 1.0 else now - 1.0, 3.0)
    assert found is not None and found[0] < 1.1 and "rebooted" in found[1]


def test_another_servos_clock_is_told_from_a_late_reply(arm: Arm) -> None:
    check = StatusCheck(arm())
    clocks = (5.0, 5.3)
    for index in range(20):
        swapped = index >= 10
        now = 0.035 * index
        for joint in (0, 1):
            tick = now + clocks[1 - joint if swapped else joint]
            if (wrong := check.look_at_clock(joint, tick, now)) is not None:
                assert wrong[0] is Cause.STALE and "another servo's data" in wrong[1] and index == 11
                return
    raise AssertionError("swapped replies were not detected")


def test_either_doubt_asks_for_another_reading(arm: Arm) -> None:
    check = StatusCheck(arm())
    check.look(0, FINE._replace(goal=0.05), 0.1, 1.0)
    assert check.is_in_doubt, "a goal that was not accepted"
    check.look(0, FINE, 0.1, 1.0)
    assert not check.is_in_doubt
    late = StatusCheck(arm())
    for index in range(4):
        late.look_at_clock(1, 0.035 * index, 0.035 * index)
        assert not late.is_in_doubt
    late.look_at_clock(1, 0.1, 0.2)
    assert late.is_in_doubt, "a clock that is behind"


def clocked(check: StatusCheck, leads: list[float], joint: int = 0) -> list[bool]:
    """Whether each reading, 100 ms apart and ahead of the computer's clock by `leads` [s], counts as stale."""
    return [check.look_at_clock(joint, 0.1 * index + lead, 0.1 * index) is not None for index, lead in enumerate(leads)]


def test_how_far_a_clock_may_be_behind(arm: Arm) -> None:
    """4 ms, and 1 % of the time since the reading before: 5 ms after 100 ms, 6 ms after 200 ms."""
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [0.9952] * 3) == [False] * 6
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [0.9948, 0.9938]) == [False] * 4 + [True]
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [0.9948, 0.9942]) == [False] * 5, "two are needed, and it may drift"
    assert clocked(StatusCheck(arm()), [1.0] * 2 + [0.9, 0.9]) == [False] * 4, "after three readings at least"
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [0.9, 0.9]) == [False] * 4 + [True]


def test_how_far_a_clock_may_be_ahead(arm: Arm) -> None:
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [1.9, 1.9]) == [False] * 5, "a request that left late"
    assert clocked(StatusCheck(arm()), [1.0] * 3 + [2.1, 2.1]) == [False] * 4 + [True], "a reboot"


def test_the_smallest_difference_of_the_clocks_counts(arm: Arm) -> None:
    """If the first requests left late, their replies look fresher; later ones must not look stale because of that."""
    assert clocked(StatusCheck(arm()), [1.3, 1.2, 1.0] + [1.0] * 5) == [False] * 8
    assert clocked(StatusCheck(arm()), [1.3, 1.0, 1.2, 1.2, 0.99, 0.98]) == [False] * 5 + [True]


def test_a_goal_that_differs_by_less_than_half_a_tick_is_the_one_sent(arm: Arm) -> None:
    check, tick = StatusCheck(arm()), 2.69e-3
    for _ in range(4):
        assert check.look(0, FINE._replace(goal=0.1 + 0.45 * tick), 0.1, 1.0) is None
    assert check.look(0, FINE._replace(goal=0.1 + 0.55 * tick), 0.1, 1.0) is None
    assert check.look(0, FINE._replace(goal=0.1 - 0.55 * tick), 0.1, 1.0) is not None


@pytest.mark.parametrize(("lead", "is_anothers"), [(5.3, True), (5.3 + 32.768, True), (5.309, False), (5.288, False)])
def test_a_clock_is_another_servos_only_if_it_agrees(arm: Arm, lead: float, is_anothers: bool) -> None:
    """The own servo's lead is 6.5 s; within 4 ms, and 1 % of the time since its last reading, it is the other one's."""
    check = StatusCheck(arm())
    clocked(check, [5.3] * 5, joint=1)
    clocked(check, [6.5] * 3)
    wrong = [check.look_at_clock(0, lead + now, now) for now in (0.4, 0.5)][-1]
    assert wrong is not None and ("another servo's" in wrong[1]) is is_anothers


def test_a_clock_that_nobody_has_learnt_is_not_another_servos(arm: Arm) -> None:
    check = StatusCheck(arm())
    clocked(check, [5.3] * 2, joint=1)
    clocked(check, [6.5] * 3)
    wrong = [check.look_at_clock(0, 5.3 + now, now) for now in (0.4, 0.5)][-1]
    assert wrong is not None and "another servo's" not in wrong[1]


def test_an_early_request_that_was_late_counts_for_nothing(arm: Arm) -> None:
    """The clock is learnt again from the three readings after it."""
    assert clocked(StatusCheck(arm()), [1.3, 1.0, 1.0, 0.9, 0.9]) == [False] * 5
    check = StatusCheck(arm())
    clocked(check, [1.3, 1.0])
    assert not check.is_in_doubt


def test_half_a_tick_of_a_voltage_is_that_of_12_volts() -> None:
    """A goal of 1 tick of PWM is 12 V / 885."""
    driven = load_config(CONFIGS / "xl430_two_link.toml")
    tick = 12.0 / 885
    for share, is_taken in ((0.45, True), (0.55, False)):
        check = StatusCheck(driven)
        for _ in range(2):
            wrong = check.look(0, FINE._replace(goal=1.0 + share * tick), 1.0, 1.0)
        assert (wrong is None) is is_taken


def test_another_servos_clock_may_have_drifted_since_its_last_reading(arm: Arm) -> None:
    """Two seconds after its last reading it may be 24 ms off."""
    for lead, is_anothers in ((5.323, True), (5.326, False), (5.277, True), (5.274, False)):
        check = StatusCheck(arm())
        clocked(check, [5.3] * 5, joint=1)  # until 0.4 s
        clocked(check, [6.5] * 3)
        wrong = [check.look_at_clock(0, lead + now, now) for now in (2.3, 2.4)][-1]
        assert wrong is not None and ("another servo's" in wrong[1]) is is_anothers


@pytest.mark.parametrize(
    ("late", "cause", "said"),
    [
        (3, Cause.STALE, "its replies are 3 cycles late"),
        (4, Cause.GOALS_LOST, "receives goals 4 cycles late"),
        (40, Cause.GOALS_LOST, "receives goals 40 cycles late"),
        (41, Cause.GOALS_LOST, "does not hold the goals of this program"),
    ],
)
def test_a_clock_that_is_right_tells_late_goals_from_late_replies(arm: Arm, late: int, cause: Cause, said: str) -> None:
    """Cycles take 2.5 ms: the clock shows delays of more than 8 ms, and requests are late by at most 0.1 s."""
    check = StatusCheck(arm())
    found = []
    for cycle in range(62):
        goal = 0.01 * cycle
        check.sent((goal, 0.0))
        held = goal if cycle < 60 else 0.01 * (cycle - late)
        now = 1.0 + 0.0025 * cycle
        found.append(check.look(0, FINE._replace(goal=held, tick=now), goal, now))
    assert found[:-1] == [None] * 61
    wrong = found[-1]
    assert wrong is not None and wrong[0] is cause and said in wrong[1]


@pytest.mark.parametrize(("ticks", "stops"), [(0, False), (5, False), (255, True)])
def test_while_an_arm_is_lowered_only_a_tripped_watchdog_stops(arm: Arm, ticks: int, stops: bool) -> None:
    wrong = StatusCheck(arm(), bears_errors=True).look_at_watchdog(ticks)
    assert (wrong is not None) is stops


@pytest.mark.parametrize(("apart", "cause"), [(0.0025, Cause.GOALS_LOST), (0.0035, Cause.STALE)])
def test_a_clock_that_stands_still_for_more_than_3_ms_shows_an_old_reply(arm: Arm, apart: float, cause: Cause) -> None:
    """It counts milliseconds."""
    check = StatusCheck(arm())
    wrong = [check.look(0, FINE._replace(goal=0.05), 0.1, 1.0 + apart * number) for number in range(2)][-1]
    assert wrong is not None and wrong[0] is cause


def foreign(check: StatusCheck, goals: Sequence[float], agrees_at: int, held: float) -> bool:
    """Whether a servo that holds `held` after `goals` were sent, the one at index `agrees_at` being the last that it
    is known to have held, counts as commanded by another program.
    """
    for number, goal in enumerate(goals):
        check.sent((goal, 0.0))
        if number == agrees_at:
            assert check.look(0, FINE._replace(goal=goal), goal, 1.0) is None
    wrong = None
    for number in range(2):
        check.sent((goals[-1], 0.0))
        now = 1.01 + 0.01 * number
        wrong = check.look(0, FINE._replace(goal=held, tick=now), goals[-1], now)
    assert wrong is not None and wrong[0] is Cause.GOALS_LOST
    return "this program never sent" in wrong[1]


@pytest.mark.parametrize(("earlier", "is_foreign"), [(3, False), (5, True)])
def test_a_servo_that_misses_goals_may_hold_one_from_shortly_before_it_was_last_right(
    arm: Arm, earlier: int, is_foreign: bool
) -> None:
    goals = [0.01 * number for number in range(20)]
    assert foreign(StatusCheck(arm()), goals, 10, 0.01 * (11 - earlier)) is is_foreign


@pytest.mark.parametrize(("before", "since", "is_foreign"), [(0, 245, True), (200, 245, True), (0, 255, False)])
def test_what_was_sent_is_known_for_256_goals(arm: Arm, before: int, since: int, is_foreign: bool) -> None:
    assert foreign(StatusCheck(arm()), [0.1] * (before + since), before, 0.3) is is_foreign


def test_a_servo_that_was_never_right_may_still_miss_goals_of_this_program(arm: Arm) -> None:
    assert not foreign(StatusCheck(arm()), [0.05, 0.05, 0.1], -1, 0.05)
    assert foreign(StatusCheck(arm()), [0.05, 0.05, 0.1], -1, 0.3)


def test_of_the_sum_of_two_servos_goals_nothing_is_known(tmp_path: Path) -> None:
    """The halves that they hold may differ in age."""
    path = tmp_path / "arm.toml"
    path.write_text(
        with_second_servo((CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")), encoding="utf-8"
    )
    assert not foreign(StatusCheck(load_config(path)), [0.05, 0.05, 0.1], 2, 0.3)
