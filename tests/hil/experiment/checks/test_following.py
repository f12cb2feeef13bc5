"""Checks of the motor current: how fast lost torque is detected, and what healthy motors may do."""

import math
from collections.abc import Callable, Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hil.config.joint import JointConfig
from hil.config.schema import Config, load_config
from hil.drivers.state import State
from hil.experiment.checks.current_noise import CurrentNoise
from hil.experiment.checks.following import GOALS, MEMORY, begin, is_frozen
from tests.support.one_joint import Following
from tests.support.paths import CONFIGS

RATES = (20, 100, 400, 1000)
REAL = ("xm430_two_link", "xl330_two_link", "xm540_two_link", "xl430_two_link")


def joints(name: str) -> list[tuple[JointConfig, float]]:
    config: Config = load_config(CONFIGS / f"{name}.toml")
    assert config.experiment.peak_torque is not None
    return [(j, peak / j.torque_per_goal) for j, peak in zip(config.joints, config.experiment.peak_torque, strict=True)]


def seen_after(
    follow: Following, rate: int, goal: Callable[[float], float], carried: Callable[[float, float], float]
) -> float:
    """Time of detection [s]; infinite if nothing is detected within ten seconds."""
    for index in range(10 * rate):
        now = index / rate
        if follow.look(goal(now), carried(goal(now), now), 1 / rate) is not None:
            return now
    return math.inf


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("joint", [0, 1])
def test_lost_torque_is_seen_within_a_tenth_of_a_second_of_a_current_worth_speaking_of(
    name: str, rate: int, joint: int
) -> None:
    """The plans use a quarter and an eighth of current_limit in the configurations of real arms."""
    config, planned = joints(name)[joint]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, rate, lambda _: 0.5 * planned, lambda goal, now: 0.0) <= 0.1


@pytest.mark.parametrize("rate", RATES)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.floats(0.0, 0.05), gain=st.floats(0.8, 1.2), lag=st.floats(0.0, 3e-3))
@example(seed=159, noise=0.0488, gain=0.875, lag=0.0)  # at 20 Hz, two replies decided
def test_a_healthy_motor_is_never_stopped(rate: int, seed: int, noise: float, gain: float, lag: float) -> None:
    """Noise relative to the planned peak, a sensor error of 20 %, a lagging current loop; multisines up to 5 Hz."""
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    random = Random(seed)
    waves = [(random.uniform(0.1, min(5.0, rate / 4.1)), random.uniform(0, math.tau)) for _ in range(8)]
    time = np.arange(10 * rate) / rate
    goals = planned / 4 * np.sum([np.sin(math.tau * f * time + phase) for f, phase in waves], axis=0)
    # Measured right after the write: mainly the previous goal, and hardly any of the newest one.
    former = np.concatenate(([0.0], goals[:-1]))
    share = 1.0 if lag < 1e-6 else 1.0 - math.exp(-0.2e-3 / lag)
    carried = gain * (former + share * (goals - former))
    for goal, current in zip(goals.tolist(), carried.tolist(), strict=True):
        assert follow.look(goal, current + random.gauss(0.0, noise * planned), 1 / rate) is None


@pytest.mark.parametrize("rate", RATES)
def test_a_healthy_motor_with_the_worst_sensor_is_not_stopped_in_many_looks(rate: int) -> None:
    """5,000 looks at a goal of which 0.8 is hardly farther from zero than the noise."""
    config, planned = joints("xm430_two_link")[0]
    follow, random = Following(config, planned, 0.3, 0.05), Random(1)
    for _ in range(5_000):
        carried = random.gauss(0.08, 0.05) * planned
        assert follow.look(0.1 * planned, carried, 1 / rate) is None


@pytest.mark.parametrize("rate", RATES[1:])
@pytest.mark.parametrize(("share", "within"), [(0.1, 0.12), (0.15, 0.06), (0.2, 0.04)])
def test_how_soon_lost_torque_is_seen(rate: int, share: float, within: float) -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, rate, lambda _: share * planned, lambda goal, now: 0.0) <= within


def test_zero_current_under_zero_goals_says_nothing() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: 0.0, lambda goal, now: 0.001) == math.inf


def test_a_current_that_is_too_large_is_seen_after_follow_time() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: planned, lambda goal, now: 1.5 * goal) == pytest.approx(0.05, abs=0.006)


def test_one_wrong_reply_in_between_is_forgiven() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: planned, lambda goal, now: 0.0 if now % 0.02 < 0.007 else goal) == math.inf


def noisy(goals: Sequence[float], noise: float, tick: float, random: Random) -> list[float]:
    return [tick * round((goal + random.gauss(0.0, noise)) / tick) for goal in goals]


@pytest.mark.parametrize("name", ["xm430_two_link", "xl330_two_link", "xm540_two_link"])
@pytest.mark.parametrize("rate", RATES)
def test_a_healthy_motor_with_a_noisy_sensor_is_not_stopped(name: str, rate: int) -> None:
    """Peaks from a fiftieth of the limit on, as in a pilot: below the noise."""
    random, config = Random(rate), joints(name)[0][0]
    for noise in (0.0, 0.005, 0.02, 0.05):
        for planned in (0.02 * config.goal_limit, 0.1 * config.goal_limit):
            follow = Following(config, planned, 0.3, 0.05)
            tick = abs(config.joint.drive_unit(12.0))
            goals = [planned * math.sin(5.0 * index / rate) for index in range(min(3 * rate, 900))]
            assert follow.rest(config, noisy([0.0] * (rate // 2), noise, tick, random), 1 / rate, planned)
            for goal, carried in zip(goals, noisy(goals, noise, tick, random), strict=True):
                assert follow.look(goal, carried, 1 / rate) is None


@pytest.mark.parametrize("rate", RATES)
def test_lost_torque_is_found_as_fast_after_a_rest_without_noise(rate: int) -> None:
    config, planned = joints("xm430_two_link")[0]
    times = []
    for rest in ([], [0.0] * rate, [0.0, 0.00269] * rate):
        follow = Following(config, planned, 0.3, 0.05)
        assert not rest or follow.rest(config, rest, 1 / rate, planned)
        times.append(seen_after(follow, rate, lambda _: 0.3 * planned, lambda goal, now: 0.0))
    assert times[0] == times[1] == times[2] < 0.15


def test_lost_torque_is_found_by_a_noisy_sensor_as_soon_as_said() -> None:
    config, planned = joints("xm430_two_link")[0]
    random, tick, found = Random(7), 2.69e-3, []
    for _ in range(10):
        follow = Following(config, planned, 0.3, 0.05)
        assert follow.rest(config, noisy([0.0] * 200, 0.05, tick, random), 0.0025, planned)
        goal = follow.seen_above(0.0025)
        found.append(seen_after(follow, 400, lambda _: goal, lambda goal, now: random.gauss(0.0, 0.05)))  # noqa: B023
    assert 0.1 < goal < 0.2 and 0.03 < sorted(found)[5] < 0.12


def test_noise_is_measured_in_spite_of_single_wrong_readings_and_of_moving_goals() -> None:
    config, random = joints("xm430_two_link")[0][0], Random(3)
    measure = CurrentNoise([config])
    due = []
    for index in range(200):
        carried = 0.5 if index % 5 == 0 else random.gauss(0.1, 0.02)
        due.append(measure.add(State(0.0, 0.0, (0.0,), (carried,), (0.0,), (0.0,), (0,), (False,))))
        measure.add(State(0.0, 0.0, (0.3,), (0.0,), (0.0,), (0.0,), (0,), (False,)))
        measure.add(State(0.0, 0.0, (0.3,), (math.nan,), (0.0,), (0.0,), (0,), (True,)))
    assert not any(due) and measure.measured() == ([0.0], [0.0]), "no goal was sent twice"
    for index in range(200):
        carried = 0.5 if index % 5 == 0 else random.gauss(0.1, 0.02)
        due.append(measure.add(State(0.0, 0.0, (0.0,), (carried,), (0.0,), (0.0,), (0,), (False,))))
    assert sum(due) == 5, "with 8, 16, 32, 64 and 128 readings"
    (noise,), (most,) = measure.measured()
    assert 0.017 < noise < 0.028 and noise < most < 1.3 * noise


STEP = 2.0**-9
"""Time between two replies [s] in the exact tests below: sums of it are not rounded."""

SHARE, LASTING = 0.3, 16 * STEP


def following(planned: float = 1.0, name: str = "xm430_two_link") -> Following:
    return Following(joints(name)[0][0], planned, SHARE, LASTING)


def replies_until_seen(
    follow: Following, goal: float, carried: float, seconds: float = STEP, followed: int = 1
) -> tuple[int, float]:
    """Number of replies with the value `carried` until that is reported, and the reported time [s].

    followed: replies before these, in which the motor carries the goal.
    """
    for _ in range(followed):
        assert follow.look(goal, goal, seconds) is None
    for number in range(1, 200):
        if (off := follow.look(goal, carried, seconds)) is not None:
            return number, off
    return 0, 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("planned", "goal", "carried", "replies"),
    [
        (1.0, 0.5, 0.0, 16),  # a ratio of 32 counts as 5: 0.15 s / (5 STEP) = 15.4
        (1.0, 0.15, 0.0, 27),  # 0.12^2 200 = 2.88: 26.7
        (1.0, 0.25, 0.05, 20),  # (0.15^2 - 0.05^2) 200 = 4: 19.2
        (1.0, 0.1, 0.04, 0),  # as near to 0.8 of the goal as to zero
        (1.0, 0.5, 0.3, 0),  # nearer to the goal
        (0.01, 0.02, 0.0, 18),  # sigma is 2 ticks of 2.69 mA: 4.42: 17.4
    ],
)
def test_replies_that_look_like_no_current(
    sign: float, planned: float, goal: float, carried: float, replies: int
) -> None:
    loose = Following(joints("xm430_two_link")[0][0], planned, 1.0, 1.0)
    assert replies_until_seen(loose, sign * goal, sign * carried) == (replies, replies * STEP)


def test_a_voltage_has_ticks_of_its_own() -> None:
    """2 ticks of 12 V / 885 are 27 mV: a ratio of 4.35."""
    follow = Following(joints("xl430_two_link")[0][0], 0.01, 1.0, 1.0)
    assert replies_until_seen(follow, 0.1, 0.0)[0] == 18


def test_one_reply_with_the_goal_takes_back_what_one_without_it_has_added() -> None:
    follow = following()
    assert replies_until_seen(follow, 0.5, 0.0, followed=5)[0] == 16
    follow = following()
    follow.look(0.5, 0.5, STEP)
    for carried in (*[0.0] * 15, 0.5):
        assert follow.look(0.5, carried, STEP) is None
    assert follow.look(0.5, 0.0, STEP) is None
    off = follow.look(0.5, 0.0, STEP)
    assert off is not None and off == 18 * STEP
    follow = following()
    for carried in (*[0.0] * 3, *[0.5] * 9):
        follow.look(0.5, carried, STEP)
    assert replies_until_seen(follow, 0.5, 0.0) == (16, 16 * STEP)


def test_a_single_reply_never_decides() -> None:
    assert replies_until_seen(following(), 0.5, 0.0, 0.0625) == (2, 0.125)
    follow = following()
    assert follow.look(0.0, 0.5, 0.0625) is None
    off = follow.look(0.0, 0.5, 0.0625)
    assert off is not None and off == 0.125, "the goal was 0 from the first one on"
    assert replies_until_seen(following(), 1.0, 0.6, 0.0625) == (2, 0.125)


@pytest.mark.parametrize(
    ("planned", "goal", "carried", "replies"),
    [
        (1.0, 0.9, 0.59, 16),  # 0.31 off; the plan allows 0.3
        (1.0, 0.9, 1.21, 16),
        (1.0, 0.9, 0.61, 0),
        (1.0, 0.9, 1.19, 0),
        (1.0, 2.0, 1.41, 0),  # more than was planned: 0.3 of the goal
        (1.0, 2.0, 1.39, 16),
        (0.01, 0.02, 0.0093, 0),  # 4 ticks are allowed, 10.76 mA
        (0.01, 0.02, 0.0091, 16),
    ],
)
def test_replies_that_are_neither_the_goal_nor_nothing(
    planned: float, goal: float, carried: float, replies: int
) -> None:
    assert replies_until_seen(following(planned), goal, carried)[0] == replies


def test_a_reply_may_be_measured_before_or_after_the_motor_has_the_goal() -> None:
    follow = following()
    for number in range(60):
        assert follow.look(0.5 if number % 2 else -0.5, 0.4 if number % 4 < 2 else -0.4, STEP) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_current_is_compared_with_the_lower_of_two_goals(sign: float) -> None:
    """Of 0.11 A, a sensor may show a fifth less: 0.088^2 200 = 1.55 from every reply but the first, 49.6 of which."""
    follow = Following(joints("xm430_two_link")[0][0], 1.0, 1.0, 1.0)
    found = [follow.look(sign * (0.5 if number % 2 else 0.11), 0.0, STEP) for number in range(51)]
    assert found == [None] * 50 + [50 * STEP]


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("turns", [False, True])
def test_readings_that_stay_the_same_while_their_goal_becomes_another_are_frozen(
    name: str, rate: int, turns: bool
) -> None:
    """The goal grows slowly. While the joint turns, another check has to judge."""
    config, planned = joints(name)[0]
    follow, start, slope = Following(config, planned, 1.0, 9.0), 0.2 * planned, 0.2 * planned
    for index in range(2 * rate):
        goal = start + slope * index / rate
        if follow.froze(goal, start, 1 / rate, 0.001 * (index % 2) * turns):
            break
    assert (index == 2 * rate - 1) == turns
    if not turns:
        # Once for the first reading, once for the latest one, and less than a block each.
        waited = 2 * slope * max(0.045, 4 / rate)
        assert follow.most_under_same < goal - start < follow.most_under_same + waited < 0.2 * planned


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("rate", RATES)
def test_a_step_of_the_goal_after_a_rest_that_a_reply_cannot_show_yet_is_no_sign_of_frozen_readings(
    name: str, rate: int
) -> None:
    """A servo may take up to 30 ms, or until the next reply, to follow."""
    config, planned = joints(name)[0]
    follow, late = Following(config, planned, 1.0, 9.0), max(1, round(0.029 * rate))
    goals = [0.0] * rate + [planned] * rate + [0.3 * planned] * rate + [-planned, planned] * late + [0.0] * rate
    for index, goal in enumerate(goals):
        assert not follow.froze(goal, goals[max(0, index - late)], 1 / rate)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("gain", [0.8, 1.0, 1.2])
def test_a_current_that_follows_in_ticks_is_not_frozen(rate: int, gain: float) -> None:
    """Without noise, with an error in proportion to the goal and hardly any current below three ticks."""
    config, planned = joints("xm430_two_link")[0]
    follow, tick = Following(config, planned, 1.0, 9.0), 2.69e-3
    for share in (1.0, 0.1, 0.02):
        for index in range(4 * rate):
            goal = share * planned * math.sin(2.0 * index / rate)
            sensed = round(gain * goal / tick)
            assert not follow.froze(goal, tick * sensed * (abs(sensed) > 2), 1 / rate)


def test_after_a_missed_reply_the_readings_begin_anew() -> None:
    config, planned = joints("xm430_two_link")[0]
    goals = np.zeros(1, GOALS)
    begin(np.zeros(1, MEMORY)[0], goals[0], config, planned, 0.3, 0.05)
    for index in range(100):
        goal = 0.5 * planned * index / 100
        found = is_frozen(goals[0], goal, 0.1, 0.01, index % 20 > 0)
        assert not found


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("rate", [*RATES, 512])
def test_frozen_readings_are_those_that_no_goals_of_30_ms_before_each_could_all_explain(rate: int, sign: float) -> None:
    """Compared with lists of all goals in the present 10 ms and in the three times 10 ms before, at random goals."""
    config, planned = joints("xm430_two_link")[0]
    goals, random = np.zeros(1, GOALS), Random(rate)
    begin(np.zeros(1, MEMORY)[0], goals[0], config, planned, 0.3, 0.05)
    most = float(goals["most"][0])
    blocks, age, former, lowest, highest, same_for = [[0.0]] * 4, 0.0, 0.0, 0.0, 0.0, 0.0
    goal, slope, found = 0.0, 0.0, []
    for index in range(3 * rate):
        if random.random() < 20.0 / rate:
            slope = random.choice((0.0, random.uniform(-5.0, 20.0))) * most
        goal += sign * slope / rate + 0.02 * most * random.gauss(0.0, 1.0)
        stands, carried = random.random() > 1.0 / rate, 0.1 if random.random() > 1.0 / rate else 0.2
        age += 1 / rate
        blocks = [[goal], *blocks[:3]] if age >= 0.0099 else [[*blocks[0], goal], *blocks[1:]]
        age = 0.0 if age >= 0.0099 else age
        low, high = min(map(min, blocks)), max(map(max, blocks))
        if not stands or carried != former:
            former, lowest, highest, same_for = carried, high, low, 0.0
        else:
            lowest, highest, same_for = min(lowest, high), max(highest, low), same_for + 1 / rate
        found.append(bool(is_frozen(goals[0], goal, carried, 1 / rate, stands)))
        assert found[-1] == (highest - lowest > most), index
        assert goals["same_for"][0] == pytest.approx(same_for)
    assert 0.01 < sum(found) / len(found) < 0.99


def rested(noise: float, planned: float, share: float = 1.0, name: str = "xm430_two_link") -> tuple[Following, float]:
    """A joint whose current was off by `noise` at rest, back and forth, and the largest sigma that this may mean [A].

    With a share of 1, only what looks like no current is found.
    """
    config = joints(name)[0][0]
    follow = Following(config, planned, share, LASTING if share < 1.0 else 1.0)
    assert follow.rest(config, [noise, *[-noise, noise] * 50], STEP, planned)
    tick = abs(config.joint.drive_unit(12.0))
    return follow, 1.4826 * (noise + 0.5 * tick) / (1.0 - 0.19)


@pytest.mark.parametrize(("noise", "replies"), [(0.001, 2), (0.1, 4)])
def test_a_noisy_sensor_must_agree_more_often_however_slow_the_rate(noise: float, replies: int) -> None:
    """Each reply counts 5 at most; 10 are needed, and 16 of a sensor that is noisier than usual."""
    follow, _ = rested(noise, 1.0)
    assert replies_until_seen(follow, 5.0, 0.0, 0.0625) == (replies, replies * 0.0625)


@pytest.mark.parametrize("share", [0.3, 0.1])
def test_a_noisy_current_may_be_four_sigma_away_besides_a_scale_error(share: float) -> None:
    """The scale error is a fifth of the plan, or less if less may be missing."""
    for nearly, is_found in ((0.98, False), (1.02, True)):
        follow, sigma = rested(0.1, 1.0, share)
        most = min(share, 0.2) + 4.0 * sigma
        assert (replies_until_seen(follow, 0.5, 0.5 + nearly * most)[0] > 0) is is_found


@pytest.mark.parametrize(("name", "tick"), [("xm430_two_link", 2.69e-3), ("xl430_two_link", 12.0 / 885)])
@pytest.mark.parametrize(("noise", "planned"), [(0.0, 0.01), (0.0, 2.0), (0.1, 0.01)])
def test_how_far_a_goal_may_go_before_readings_that_stay_the_same_are_frozen(
    name: str, tick: float, noise: float, planned: float
) -> None:
    """Noise, ticks or a share of the plan, whichever is most, and a tick, of a sensor that shows a fifth less."""
    follow, sigma = rested(noise, planned, name=name)
    known = max(0.05 * planned, 4.0 * tick, 4.0 * sigma if noise else 0.0)
    assert follow.most_under_same == pytest.approx((known + tick) / 0.8, rel=0.01)


@pytest.mark.parametrize(("interval", "needed"), [(0.0025, 1.5), (0.05, 5.0)])
def test_from_which_goal_on_lost_torque_is_found_in_a_tenth_of_a_second(interval: float, needed: float) -> None:
    """A log likelihood ratio of 50 per second, or of 10 in two replies at 20 Hz; 0.8 of the goal counts."""
    follow = following()
    assert follow.seen_above(interval) == pytest.approx(math.sqrt(2.0 * needed) * 0.05 / 0.8)
    assert seen_after(follow, round(1 / interval), lambda _: 1.3 * follow.seen_above(interval), lambda *_: 0.0) <= 0.1


def test_a_small_plan_in_volts_allows_four_ticks() -> None:
    for ticks, is_found in ((3.9, False), (4.1, True)):
        follow = following(0.01, "xl430_two_link")
        assert (replies_until_seen(follow, 0.0, ticks * 12.0 / 885)[0] > 0) is is_found
