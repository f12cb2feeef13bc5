"""What the latest exchanges tell about a joint's motion: spans, their uncertainty, and readings that are too old."""

from collections.abc import Callable, Sequence
from math import nan, pi

import pytest

from hil.config.schema import Config
from hil.drivers.state import State
from hil.plan.recent_motion import RecentMotion

Arm = Callable[..., Config]
AT_20_HZ = ("rate = 400.0", "rate = 20.0"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]")
START_S = 100.0
STEP = 2 * 0.0015339807878856412  # rad: the uncertainty of a change of position is two encoder steps


def at(seconds: float, position: float, *, took: float = 0.001, velocity: float = 0.0, current: float = 0.0) -> State:
    """An exchange `seconds` after the start in which the second joint is at `position`."""
    begun = START_S + seconds
    return State(
        begun, begun + took, (0.0, 0.1), (0.0, current), (0.0, velocity), (0.0, position), (0, 0), (False, False)
    )


def motion(config: Config, states: Sequence[State], interval: float | None = None) -> RecentMotion:
    recent = RecentMotion(config, interval)
    for state in states:
        recent.add(state)
    return recent


@pytest.mark.parametrize(
    ("edits", "age", "is_known"),
    [((), 0.049, True), ((), 0.051, False), (AT_20_HZ, 0.074, True), (AT_20_HZ, 0.076, False)],
)
def test_a_position_is_used_for_50_ms_or_one_and_a_half_intervals(
    arm: Arm, edits: Sequence[tuple[str, str]], age: float, is_known: bool
) -> None:
    recent = motion(arm(*edits), [at(0.0, 0.0), at(age, 0.1)])
    assert bool(recent.travels(1)) is is_known
    assert recent.speeds()[1] == (pytest.approx((0.1 - STEP) / age) if is_known else 0.0)


def test_each_span_begins_at_the_newest_exchange_that_is_old_enough(arm: Arm) -> None:
    """4 and 20 ms, with exchanges every 1/1024 s."""
    recent = motion(arm(), [at(number / 1024, 0.001 * number) for number in range(24)], 1 / 1024)
    short, long = recent.travels(1)
    assert (short.seconds, long.seconds) == (5 / 1024, 21 / 1024)
    assert (short.moved, long.moved) == (pytest.approx(0.005), pytest.approx(0.021))
    assert recent.speeds() == [0.0, pytest.approx((0.021 - STEP) * 1024 / 21)]


def test_a_joint_without_any_change_of_position_has_no_speed(arm: Arm) -> None:
    assert motion(arm(), [at(0.0, 0.3), at(0.01, 0.3)]).speeds() == [0.0, 0.0]
    once = motion(arm(), [at(0.0, 0.3, velocity=2.0)])
    assert once.speeds() == [0.0, 0.0] and once.travels(1) == []


@pytest.mark.parametrize(
    ("first", "last", "least"), [(0.001, 0.001, 0.01), (0.001, 0.003, 0.008), (0.009, 0.001, 0.005)]
)
def test_the_range_of_velocities_allows_for_exchanges_of_different_length(
    arm: Arm, first: float, last: float, least: float
) -> None:
    """A servo may measure at any time during its exchange, but half of the time between two is always counted."""
    recent = motion(arm(), [at(0.0, 0.0, took=first), at(0.01, 0.02, took=last)])
    for travel in recent.travels(1):
        assert travel.low == 0.0 and travel.high == pytest.approx(1.25 * (0.02 + STEP) / least)
    back = motion(arm(), [at(0.0, 0.0, took=first), at(0.01, -0.02, took=last)])
    for travel in back.travels(1):
        assert travel.high == 0.0 and travel.low == pytest.approx(-1.25 * (0.02 + STEP) / least)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_velocity_of_more_than_twice_what_the_position_allows_contradicts_it(arm: Arm, sign: float) -> None:
    recent = motion(arm(), [at(0.0, 0.0), at(0.01, sign * 0.02)])
    most = sign * 1.25 * (0.02 + STEP) / 0.01
    assert not recent.contradicts(1, 1.99 * most) and recent.contradicts(1, 2.01 * most)
    assert recent.contradicts(1, -0.01 * sign), "the direction opposite to a visible motion"


def test_without_an_answer_to_the_latest_exchange_nothing_is_known(arm: Arm) -> None:
    silent = at(0.02, nan)
    recent = motion(arm(), [at(0.0, 0.0), at(0.01, 0.02), silent])
    assert recent.travels(1) == [] and recent.believed(silent)[1] == 0.0
    earlier = recent.previous(1)
    assert earlier is not None and earlier.position[1] == 0.02
    answers = motion(arm(), [at(0.0, 0.0), at(0.01, nan), at(0.02, 0.04)])
    assert [travel.seconds for travel in answers.travels(1)] == [pytest.approx(0.02)] * 2


def test_the_previous_exchange_is_not_the_newest_one(arm: Arm) -> None:
    states = [at(0.0, 0.0), at(0.01, 0.02), at(0.02, 0.04)]
    assert motion(arm(), states).previous(1) is states[1]
    assert motion(arm(), states[:1]).previous(1) is None


def test_the_motion_until_an_earlier_exchange_includes_it_and_nothing_later(arm: Arm) -> None:
    states = [at(0.01 * number, 0.02 * number, current=0.1 * number) for number in range(4)]
    recent = motion(arm(), states)
    assert [current for _, current in recent.until(states[2]).currents(1)] == pytest.approx([0.1, 0.2])
    assert [current for _, current in recent.currents(1)] == pytest.approx([0.1, 0.2, 0.3])


def test_an_exchange_is_stored_once(arm: Arm) -> None:
    states = [at(0.0, 0.0), at(0.01, 0.02)]
    assert len(motion(arm(), [states[0], states[1], states[1]]).currents(1)) == 1


@pytest.mark.parametrize("velocity", [1.0, -1.0])
def test_readings_are_old_if_the_joint_must_have_moved_by_two_steps_meanwhile(arm: Arm, velocity: float) -> None:
    """At 1 rad/s, two encoder steps take 3 ms."""
    assert not RecentMotion(arm()).is_old(1)
    same = [at(0.001 * number, 0.5, velocity=velocity) for number in range(5)]
    assert not motion(arm(), same[:4], 0.001).is_old(1) and motion(arm(), same, 0.001).is_old(1)
    moved = at(0.005, 0.505, velocity=velocity)
    assert not motion(arm(), [*same, moved], 0.001).is_old(1)


def test_no_servo_is_three_times_as_fast_as_without_load_at_its_highest_voltage(arm: Arm) -> None:
    """XM430-W350: 46 rpm without load at 12 V; published up to 14.8 V."""
    fastest = 3 * 46 * 2 * pi / 60 * 14.8 / 12
    once = motion(arm(), [at(0.0, 0.3)])
    for sign in (1.0, -1.0):
        assert once.contradicts(1, 1.01 * sign * fastest) and not once.contradicts(1, 0.99 * sign * fastest)
