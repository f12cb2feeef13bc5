"""How far position and velocity may be apart, part by part, and what is remembered of them."""

import math
from random import Random

import pytest

from hil.drivers.state import State
from hil.errors import Cause, SafetyStop
from hil.experiment.checks.consistency import CURVED, check_standstill, moved_at_standstill
from tests.support.one_joint import Consistency

SLOW_S, LONG_EVERY_S = 20.0, 0.0099
SHORTLY = 0.01
"""An interval after which the long memories take all that they have been told [s]."""


def motion_with_rests(count: int, seed: int) -> list[tuple[float, float, float, float]]:
    """Seconds, position, velocity and how unsure its time is: a swing one way, a rest, a small jump, and a swing back.

    At rest, the position first drifts slowly and then jumps by less than a servo would be stopped for.
    """
    samples: list[tuple[float, float, float, float]] = []
    random, now, angle = Random(seed), 0.0, 0.0
    for index in range(count):
        seconds = random.choice((0.002, 0.0025, 0.004)) if index else 0.0
        now += seconds
        rests = 0.3 * count < index < 0.6 * count
        velocity = 0.0 if rests else math.sin(2.0 * now) * (1.0 if index < 0.5 * count else -0.4)
        drift = 0.02 if rests and index < 0.4 * count else 0.0
        angle += seconds * ((samples[-1][2] + velocity) / 2 if samples else 0.0) + drift * seconds
        angle += 0.014 * (index == int(0.5 * count)) + 1e-5 * random.gauss(0.0, 1.0)
        samples.append((seconds, angle, velocity, random.choice((0.0, 1e-5))))
    return samples


def test_the_slow_memory_holds_what_its_definition_says() -> None:
    samples = motion_with_rests(900, 1)
    look = Consistency()
    memory = look.memory
    apart = far = heading = roughness = behind = turn = 0.0
    seen = moved = headed = rough = since = curved = 0.0
    mean, moving, highest, lowest, curved_most = samples[0][2], 0.0, samples[0][2], samples[0][2], 0.0
    for (_, former, before, _), (seconds, position, velocity, unsure) in zip(
        [samples[0], *samples[:-1]], samples, strict=True
    ):
        assert not look.look(position, velocity, seconds, unsure)
        moved += position - former
        rough += (CURVED * seconds * (velocity - before - turn)) ** 2
        turn = velocity - before
        if before + velocity == 0.0:
            slowest = 0.025 * seconds  # motion of less than one step of the velocity register
            behind += position - former
            behind = behind - slowest if behind > slowest else behind + slowest if behind < -slowest else 0.0
            kept = min(max(behind, -0.0077), 0.0077)
            seen, behind = seen + behind - kept, kept
        else:
            seen += position - former - 0.5 * (before + velocity) * seconds
            headed += math.copysign(seconds, before + velocity)
            moving += seconds
        curved = max(curved, CURVED * seconds * abs(velocity - before))
        since += seconds
        if since >= LONG_EVERY_S:
            kept = 1.0 - since / SLOW_S
            apart, far, heading = kept * apart + seen, kept * far + moved, kept * heading + headed
            roughness, moving = kept * roughness + rough, kept * moving
            mean = kept * mean + (1.0 - kept) * velocity
            highest = max(kept * highest + (1.0 - kept) * velocity, velocity)
            lowest = min(kept * lowest + (1.0 - kept) * velocity, velocity)
            curved_most = max(kept * curved_most, curved)
            seen = moved = headed = rough = since = curved = 0.0
    assert apart > 0.004 and abs(heading) > 0.1 and moving > 1.0, "each of them was put to the test"
    for name, value in (("apart", apart), ("far", far), ("mean", mean), ("span", highest - lowest)):
        assert memory["slow"][name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    assert memory["slow"]["unknown"] == memory["long"]["unknown"] > 0.0
    for name, value in (("heading", heading), ("moving", moving), ("roughness", roughness), ("behind", behind)):
        assert memory[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    assert (memory["seen"], memory["moved"]) == (pytest.approx(seen, abs=1e-12), pytest.approx(moved))
    assert memory["slow"]["curved"] == pytest.approx(curved_most)


def test_after_lost_replies_nothing_is_remembered_of_the_motion() -> None:
    look = Consistency()
    for seconds, position, velocity, unsure in motion_with_rests(100, 2):
        look.look(position, velocity, seconds, unsure)
    memory = look.memory
    sums = "seconds", "moved", "difference", "unknown", "most_curved", "seen", "headed", "rough"
    of_motion = "turn", "heading", "moving", "roughness", "behind"
    for name in (*sums, *of_motion):
        memory[name] = 0.5
    for part in ("short", "long", "slow"):
        for name in ("apart", "far", "span", "curved", "unknown", "mean", "highest", "lowest"):
            memory[part][name] = 0.5
    memory["same"]["count"] = memory["same"]["moved"] = 0.5
    memory["position"] = math.nan
    look.look(9.0, 3.0, 0.1, 0.001)
    assert all(memory[name] == 0.0 for name in (*sums, *of_motion))
    for part in ("short", "long", "slow"):
        assert all(memory[part][name] == 0.0 for name in ("apart", "far", "span", "curved"))
        assert all(memory[part][name] == 3.0 for name in ("mean", "highest", "lowest"))
        assert memory[part]["unknown"] == pytest.approx(0.003)
    assert memory["same"]["count"] == memory["same"]["moved"] == 0.0


def test_an_interval_longer_than_the_slow_memory_leaves_nothing_of_what_was_before() -> None:
    look = Consistency()
    look.look(0.0, 0.2, 0.0)
    look.memory["heading"], look.memory["roughness"], look.memory["slow"]["apart"] = -9.0, 9.0, 0.01
    look.look(6.0, 0.2, 30.0)
    assert (look.memory["heading"], look.memory["roughness"]) == (30.0, pytest.approx(0.0, abs=1e-9))
    assert look.memory["slow"]["apart"] == pytest.approx(0.0, abs=1e-9)


def told(part: str, **fields: float) -> Consistency:
    """A joint at 1 rad/s whose memory `part` holds these; lag and scale error are 0.01 s and 0.05 at most."""
    look = Consistency()
    look.look(0.0, 1.0, 0.0)
    memory = look.memory
    memory["lag"], memory["scale"] = 0.01, 0.05
    memory["short"]["far"] = 1e-6  # it is not its first interval
    for name, value in fields.items():
        (memory if name in memory.dtype.names else memory[part])[name] = value
    return look


def is_found(look: Consistency) -> bool:
    """Whether anything is found after a short interval, in which the joint moved at 1 rad/s."""
    return look.look(SHORTLY, 1.0, SHORTLY)


NEARLY, BEYOND = 0.97, 1.03
"""Of each limit; the short interval itself changes the memories by less than 1 %."""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("part", "fields", "most"),
    [
        ("long", {}, 0.045),
        ("long", {"far": 2.0}, 0.145),
        ("long", {"far": -2.0}, 0.145),
        ("long", {"curved": 0.03}, 0.075),
        ("long", {"unknown": 0.03}, 0.075),
        ("long", {"highest": 9.0, "lowest": -7.0}, 0.085),
        ("slow", {}, 0.04),
        ("slow", {"far": 2.0}, 0.14),
        ("slow", {"curved": 0.03}, 0.07),
        ("slow", {"highest": 9.0, "lowest": -7.0}, 0.08),
        ("slow", {"roughness": 1e-4}, 0.06),
        ("slow", {"moving": 10.0}, 0.165),  # half a step of the velocity register all the time
        ("slow", {"moving": 10.0, "heading": 10.0}, 0.29),  # a whole step in one direction
        ("slow", {"moving": 10.0, "heading": -10.0}, 0.29),
        ("slow", {"moving": 10.0, "heading": 1.0}, 0.165),
        ("slow", {"moving": 10.0, "heading": 10.0, "roughness": 1e-4}, 0.31),
        ("slow", {"moving": 10.0, "least": 0.0, "most": 0.0}, 0.07),  # but 3 mrad/s, a known bias may change
    ],
)
def test_the_tolerances_of_the_long_memories_are_sums(
    part: str, fields: dict[str, float], most: float, sign: float
) -> None:
    assert not is_found(told(part, apart=sign * NEARLY * most, **fields))
    assert is_found(told(part, apart=sign * BEYOND * most, **fields))


@pytest.mark.parametrize(("part", "most"), [("long", 0.045), ("slow", 0.04)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_lag_explains_a_difference_in_its_own_direction_only(part: str, most: float, sign: float) -> None:
    """The mean velocity was 4 rad/s less, or more, than now: a lag of 10 ms makes 40 mrad."""
    for apart, is_too_much in (
        (sign * NEARLY * (most + 0.04), False),
        (sign * BEYOND * (most + 0.04), True),
        (-sign * NEARLY * most, False),
        (-sign * BEYOND * most, True),
    ):
        assert is_found(told(part, apart=apart, mean=1.0 - sign * 4.0)) is is_too_much


def creeping(apart: float, lags: dict[str, float], **fields: float) -> Consistency:
    """A joint whose lag and scale error are known, so that smaller differences are found."""
    look = told("slow", apart=apart, learnt=1.0, **fields)
    memory = look.memory
    memory["scale"] = 9.0  # the other checks accept anything
    memory["lags"]["information"] = 1.0
    for name, value in lags.items():
        memory["lags"][name] = value
    return look


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("lags", "fields", "errors"),
    [
        ({}, {}, 0.01),
        ({"noise": 0.01}, {}, 0.03),
        ({"lag_std": 0.01}, {"mean": 2.0}, 0.032),
        ({"scale_std": 0.01}, {"far": 2.0}, 0.06),
        ({}, {"far": -4.0}, 0.03),
        ({}, {"mean": 6.0}, 0.02),
        ({"lag": 0.02}, {"highest": 5.0, "lowest": -6.0}, 0.032),
        ({"lag": -0.02}, {"highest": 5.0, "lowest": -6.0}, 0.032),
        ({}, {"curved": 0.02}, 0.03),
        ({}, {"unknown": 0.02}, 0.03),
        ({}, {"roughness": 1e-4}, 0.03),
        ({}, {"heading": 1.0}, 0.035),
        ({}, {"heading": -1.0}, 0.035),
    ],
)
def test_what_may_be_taken_for_creep_is_a_sum(
    lags: dict[str, float], fields: dict[str, float], errors: float, sign: float
) -> None:
    """Twice these errors are accepted, besides the difference that a bias explains: 25 mrad in two seconds."""
    most = 2.0 * errors + 0.025
    fields = {"moving": 2.0, **fields}
    assert not is_found(creeping(sign * NEARLY * most, lags, **fields))
    assert is_found(creeping(sign * BEYOND * most, lags, **fields))


def test_what_lag_and_scale_error_explain_is_no_creep() -> None:
    """A velocity that is 2 rad/s above its mean and 20 ms late; 3 rad, of which the velocity gave 2 % too little."""
    known = {"lag": 0.02, "scale": 0.02}
    fields = {"moving": 2.0, "mean": -1.0, "far": 3.0}
    errors = 0.01 + 0.002 * 2.0 + 0.005 * 3.0 + 0.1 * 0.02 * 2.0
    for away in (1.0, -1.0):
        for share, is_too_much in ((NEARLY, False), (BEYOND, True)):
            look = creeping(0.04 + 0.06 + away * share * (2.0 * errors + 0.025), known, **fields)
            look.memory["slow"]["highest"], look.memory["slow"]["lowest"] = 1.0, -1.0
            assert is_found(look) is is_too_much


@pytest.mark.parametrize(
    ("lag", "scale", "most_lag", "most_scale"),
    [
        (0.005, 0.01, 0.022, 0.046),
        (0.005, -0.01, 0.022, 0.046),
        (-0.005, 0.0, 0.012, 0.026),  # no velocity is early
        (0.02, 0.03, 0.03, 0.06),  # but never more than of any servo
    ],
)
def test_what_has_been_learnt_bounds_what_is_accepted(
    lag: float, scale: float, most_lag: float, most_scale: float
) -> None:
    look = Consistency()
    look.look(0.0, 1.0, 0.0)
    lags = look.memory["lags"]
    lags["lag"], lags["lag_std"], lags["scale"], lags["scale_std"] = lag, 0.002, scale, 0.003
    look.look(0.001, 1.0, 0.001)
    assert (look.memory["lag"], look.memory["scale"]) == (0.03, 0.06), "as long as nothing is known"
    lags["information"] = 1.0
    look.look(0.002, 1.0, 0.001)
    assert look.memory["lag"] == pytest.approx(most_lag) and look.memory["scale"] == pytest.approx(most_scale)


@pytest.mark.parametrize(("unsure", "counted"), [(0.0019, 0.002), (0.0021, 0.0)])
def test_no_lag_is_estimated_from_a_state_whose_time_is_unknown(unsure: float, counted: float) -> None:
    look = Consistency()
    look.look(0.0, 1.0, 0.0)
    look.look(0.002, 1.0, 0.002, unsure)
    assert look.memory["lags"]["block"].max() == counted


def looks_until_frozen(
    rate: int, first: float, velocity: float = 1.0, unsure: float = 0.0, scale: float = 0.06, skipped: int = 0
) -> int | None:
    """Number of intervals until a velocity counts as frozen: in the first 10 ms, the joint moves by `first` [rad].

    skipped: intervals before, in which it moves at its velocity.
    """
    look = Consistency()
    look.look(0.0, velocity, 0.0, unsure)
    look.memory["scale"] = scale
    at_first, position = max(1, rate // 100), 0.0
    for number in range(1, 8 * at_first):
        position += first / at_first if skipped < number <= skipped + at_first else velocity / rate
        for part in ("short", "long", "slow"):
            look.memory[part]["unknown"] = 9.0  # these accept anything
        if look.look(position, velocity, 1 / rate, unsure):
            return number
    return None


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("rate", "number"), [(1000, 40), (400, 16), (100, 4), (50, 3), (33, 2), (20, 2)])
def test_a_velocity_that_stays_the_same_was_that_of_the_joint_30_ms_ago(rate: int, number: int, sign: float) -> None:
    """20 mrad, 6 % of the distance and one step of the velocity register are accepted."""
    seconds = max(1, rate // 100) / rate
    most = (0.02 + 0.025 * seconds + seconds) / 0.94
    assert looks_until_frozen(rate, sign * NEARLY * most, sign) is None
    assert looks_until_frozen(rate, sign * BEYOND * most, sign) == number


@pytest.mark.parametrize(("rate", "skipped", "number"), [(400, 4, 20), (100, 1, 5), (50, 1, 4), (20, 1, 3)])
def test_what_a_joint_did_less_than_30_ms_ago_may_not_show_in_its_velocity_yet(
    rate: int, skipped: int, number: int
) -> None:
    assert looks_until_frozen(rate, 0.15, skipped=skipped) == number


@pytest.mark.parametrize(
    ("velocity", "unsure", "scale", "most"),
    [
        (1.0, 0.0, 0.02, 0.03025 / 0.98),
        (1.0, 0.001, 0.06, (0.03025 + 0.008) / 0.94),  # both ends of all four intervals
        (3.0, 0.001, 0.06, (0.05025 + 0.024) / 0.94),
    ],
)
def test_how_far_a_joint_may_go_at_a_velocity_that_stays_the_same(
    velocity: float, unsure: float, scale: float, most: float
) -> None:
    assert looks_until_frozen(100, NEARLY * most, velocity, unsure, scale) is None
    assert looks_until_frozen(100, BEYOND * most, velocity, unsure, scale) == 4


@pytest.mark.parametrize(("velocity", "number"), [(0.31, 4), (-0.31, 4), (0.29, None), (-0.29, None)])
def test_a_joint_that_hardly_moves_may_stick_and_slip(velocity: float, number: int | None) -> None:
    assert looks_until_frozen(100, 0.05, velocity) == number


def jumps(look: Consistency, step: float, seconds: float = SHORTLY) -> None:
    """Let a joint at rest jump back and forth; a scale error explains 6 % of it."""
    back = -1.0 if look.memory["position"] > 0.0 else 1.0
    look.look(float(look.memory["position"]) + back * step / 0.94, 0.0, seconds)


@pytest.mark.parametrize(
    ("usual", "least"), [(0.0, 0.0077), (0.001, 0.0077), (0.002, 0.014)], ids=["none", "little", "much"]
)
def test_a_jump_is_seven_times_as_large_as_usual(usual: float, least: float) -> None:
    """A larger one counts as that much, so that a few jumps do not become usual."""
    for share, count in ((NEARLY, 0.0), (BEYOND, 1.0)):
        look = Consistency()
        look.look(0.0, 0.0, 0.0)
        steps = look.memory["steps"]
        steps["square"], steps["age"], steps["since"] = usual**2, 5.0, 0.6
        jumps(look, share * least)
        assert steps["count"] == count
        wanted = usual**2 + SHORTLY / 1.2 * ((min(share, 1.0) * least) ** 2 - usual**2)
        assert steps["square"] == pytest.approx(wanted)


@pytest.mark.parametrize(("age", "count"), [(0.28, 0.0), (0.3, 1.0)])
def test_the_first_jumps_are_what_is_usual(age: float, count: float) -> None:
    look = Consistency()
    look.look(0.0, 0.0, 0.0)
    steps = look.memory["steps"]
    steps["age"] = age
    jumps(look, 0.009)
    assert steps["count"] == count and steps["age"] == pytest.approx(age + SHORTLY)
    assert steps["square"] == pytest.approx(SHORTLY / steps["age"] * min(0.009, 9.0 if not count else 0.0077) ** 2)


@pytest.mark.parametrize(("since", "count"), [(0.48, 3.0), (0.5, 1.0)])
def test_only_jumps_soon_after_one_another_are_counted(since: float, count: float) -> None:
    look = Consistency()
    look.look(0.0, 0.0, 0.0)
    steps = look.memory["steps"]
    steps["age"], steps["since"], steps["count"] = 5.0, since, 2.0
    jumps(look, 0.009)
    assert steps["count"] == count and steps["since"] == 0.0


def test_an_interval_of_no_duration_holds_no_jump() -> None:
    look = Consistency()
    look.look(0.0, 0.0, 0.0)
    look.memory["steps"]["age"] = 5.0
    jumps(look, 0.015, 0.0)
    assert look.memory["steps"]["count"] == 0.0


def stood(*times_and_positions: tuple[float, float], velocity: float = 0.0) -> list[State]:
    """The states of a joint, the latest first."""
    return [
        State(now, now + 0.001, (0.0,), (0.0,), (velocity,), (position,), (0,), (False,))
        for now, position in reversed(times_and_positions)
    ]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("seconds", "most"), [(0.01, 0.0087), (0.05, 0.0127)])
def test_a_joint_at_standstill_may_move_by_a_jump_and_at_the_speed_that_counts_as_still(
    seconds: float, most: float, sign: float
) -> None:
    for share, is_said in ((NEARLY, False), (BEYOND, True)):
        states = stood((0.0, 0.0), (seconds, sign * share * most))
        assert bool(moved_at_standstill(states, 0, 0.1)) is is_said
    assert moved_at_standstill(stood((0.0, 0.0), (seconds, sign), velocity=0.1), 0, 0.1) == "", "it moves"


@pytest.mark.parametrize(("gap", "is_said"), [(0.058, True), (0.062, False)])
def test_what_a_joint_did_in_a_gap_is_unknown(gap: float, is_said: bool) -> None:
    states = stood((0.0, 0.0), (gap, 0.3), (gap + 0.01, 0.3))
    assert bool(moved_at_standstill(states, 0, 0.1)) is is_said


def test_a_joint_that_moves_at_a_velocity_of_zero_stops_the_arm() -> None:
    check_standstill("Joint 'elbow'", stood((0.0, 0.0), (0.01, 0.001)), 0, 0.1)
    with pytest.raises(SafetyStop, match=r"'elbow' reports .* \+0\.00 rad/s .* \+0\.300 rad in the last 10 ms") as stop:
        check_standstill("Joint 'elbow'", iter(stood((0.0, 0.0), (0.01, 0.3))), 0, 0.1)
    assert stop.value.cause is Cause.FROZEN
