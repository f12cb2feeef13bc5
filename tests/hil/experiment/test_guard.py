"""The guard alone: each cause of a stop, and the computing time of a check."""

import re
from collections.abc import Callable
from itertools import pairwise
from math import inf, nan, sin, tau
from random import Random
from timeit import timeit
from typing import Any

import pytest

from hil.config.schema import Config
from hil.drivers.servo_model import WATCHDOG_UNIT
from hil.drivers.state import Slow, State, Status
from hil.errors import Cause, SafetyStop
from hil.experiment.guard import Guard
from tests.support.motion import STILL, at

Arm = Callable[..., Config]
AT_20_HZ = ("rate = 400.0", "rate = 20.0"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]")
MISSING = STILL._replace(current=(0.0, nan), velocity=(0.0, nan), position=(-1.57, nan), missing=(False, True))
PLANNED = 0.85, 0.85  # A: with it, 0.034 A rad may be returned
NOTHING_SLOW = Slow((nan, nan), (nan, nan), (nan, nan))


def look(guard: Guard, *states: State) -> Cause:
    """Pass the states to the guard; return the cause for which it stops at the last one."""
    for state in states[:-1]:
        guard.look(state)
    with pytest.raises(SafetyStop) as stop:
        guard.look(states[-1])
    assert "joint '" in str(stop.value).lower() and "ID " in str(stop.value)
    return stop.value.cause


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"position": (1.07, 0.0)}, Cause.POSITION),
        ({"position": (nan, 0.0)}, Cause.POSITION),
        ({"velocity": (15.1, 0.0)}, Cause.VELOCITY),
        ({"velocity": (nan, 0.0)}, Cause.VELOCITY),
        ({"velocity": (60.0, 0.0)}, Cause.FROZEN),
        ({"error": (0, 0x80)}, Cause.ALERT),
        ({"error": (0, 0x80), "missing": (False, True)}, Cause.ALERT),
        ({"slow": NOTHING_SLOW._replace(temperature=(71.0, nan))}, Cause.TEMPERATURE),
        ({"slow": NOTHING_SLOW._replace(voltage=(nan, 31.0))}, Cause.VOLTAGE),
    ],
)
def test_one_sample_that_stops(arm: Arm, change: dict[str, Any], cause: Cause) -> None:
    assert look(Guard(arm()), STILL._replace(**change)) is cause


def test_an_encoder_jump_stops_and_the_same_way_over_lost_samples_does_not(arm: Arm) -> None:
    fast = STILL._replace(velocity=(0.0, 19.0))
    moved = fast._replace(position=(-1.57, 19.0 * 3 / 400))
    assert look(Guard(arm()), fast, at(1, moved)) is Cause.JUMP
    with pytest.raises(SafetyStop, match=r"encoder, its magnet.*horn slips\.$"):
        look_again = Guard(arm())
        look_again.look(fast)
        look_again.look(at(1, moved))
    guard = Guard(arm())
    for number, state in enumerate((fast, MISSING, MISSING, moved)):
        guard.look(at(number, state))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("claimed", "moves", "cause"),
    [
        (15.1, 14.9, Cause.VELOCITY),
        (15.1, 1.0, Cause.FROZEN),
        (15.1, -10.0, Cause.FROZEN),
        (60.0, 10.0, Cause.FROZEN),
        (19.5, 19.0, Cause.VELOCITY),
    ],
    ids=["agrees", "hardly moves", "moves back", "no servo reaches it", "agrees, but no servo reaches it"],
)
@pytest.mark.parametrize("rate", [20.0, 100.0, 400.0])
def test_a_velocity_beyond_its_limit_that_contradicts_the_position(
    arm: Arm, rate: float, claimed: float, moves: float, cause: Cause, sign: float
) -> None:
    interval = min(1 / rate, 0.01)
    guard = Guard(arm(), interval=interval)
    for number in range(2):
        now, way = number * interval, sign * moves * interval * number
        state = STILL._replace(time_before_write=now, time_after_read=now + 0.001, position=(-1.57 + way, 0.0))
        if number == 0:
            guard.look(state._replace(velocity=(sign * min(abs(moves), 14.0), 0.0)))
    with pytest.raises(SafetyStop) as stop:
        guard.look(state._replace(velocity=(sign * claimed, 0.0)))
    assert stop.value.cause is cause
    assert ("contradicts its position" in str(stop.value)) == (cause is Cause.FROZEN)
    assert ("can reach" in str(stop.value)) == (claimed == 60.0)
    assert ("begun to slip" in str(stop.value)) == (cause is Cause.FROZEN and claimed != 60.0)
    assert ("its horn slips, something has struck" in str(stop.value).lower()) == (claimed == 19.5)


def test_a_frozen_encoder_is_seen_between_lost_replies(arm: Arm) -> None:
    """A reply lost now and then must not restart the comparison of position and velocity."""
    guard = Guard(arm())
    fast = STILL._replace(velocity=(0.0, 4.0))
    with pytest.raises(SafetyStop) as stop:
        for number in range(60):
            guard.look(at(number, MISSING if number % 2 else fast))
    assert stop.value.cause is Cause.FROZEN and "or the horn slips. Check the horn, the encoder" in str(stop.value)


def test_replies_may_be_missing_but_not_too_many_in_a_row(arm: Arm) -> None:
    guard = Guard(arm())
    for state in (*[MISSING] * 5, STILL, *[MISSING] * 5):
        guard.look(state)
    assert look(guard, MISSING) is Cause.MISSING


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ((False, True), "Requests or replies are lost: check its cable and its supply."),
        (
            (True, True),
            "No servo replied; requests or replies are lost: check the adapter, the cables and the supply.",
        ),
    ],
)
def test_silence_of_all_servos_points_to_what_they_share(arm: Arm, missing: tuple[bool, bool], said: str) -> None:
    guard = Guard(arm())
    silent = MISSING._replace(missing=missing)
    with pytest.raises(SafetyStop) as stop:
        for number in range(10):
            guard.look(at(number, silent))
    assert str(stop.value).endswith(said)


@pytest.mark.parametrize("missing", [(False, True), (True, True)])
def test_what_was_heard_instead_replaces_the_remedy_for_silence(arm: Arm, missing: tuple[bool, bool]) -> None:
    """Otherwise the message would say first that nothing was heard, then that replies arrived."""
    guard = Guard(arm(), heard_instead=lambda: "Replies did arrive, but too late.")
    with pytest.raises(SafetyStop, match=r"allows 15 ms\. Replies did arrive, but too late\.$") as stop:
        for number in range(10):
            guard.look(at(number, MISSING._replace(missing=missing)))
    assert stop.value.cause is Cause.MISSING


@pytest.mark.parametrize("heard", ["", "Replies are repeated in transit."])
def test_what_was_heard_beside_the_replies_explains_lost_goals(arm: Arm, heard: str) -> None:
    """Both where the status shows them, and where read-backs between cycles do."""
    held = at(1, STILL)._replace(
        goal_current=(0.0, 0.1),
        status=tuple(Status(4, 0.0, 0.0, torque=True, hardware_error=0) for _ in range(2)),
    )
    guard = Guard(arm(), heard_instead=lambda: heard)
    guard.look(held)
    for stops in (
        lambda: guard.look(at(2, held)),
        lambda: guard.goals_are_lost(1, "its Goal Current reads 3, but 4 was sent"),
    ):
        with pytest.raises(SafetyStop, match=heard or "Goals are being lost in transit") as stop:
            stops()
        assert stop.value.cause is Cause.GOALS_LOST and ("being lost" in str(stop.value)) == (not heard)


@pytest.mark.parametrize(("velocity", "cause"), [(1.0, Cause.STALE), (0.0, Cause.GOALS_LOST)])
def test_readings_that_stay_the_same_in_motion_are_old_and_show_no_lost_goals(
    arm: Arm, velocity: float, cause: Cause
) -> None:
    guard = Guard(arm())
    for number in range(4):
        guard.recent.add(at(number, STILL)._replace(velocity=(0.0, velocity)))
    with pytest.raises(SafetyStop, match=r"old replies|repeats or delays") as stop:
        guard.goals_are_lost(1, "its Goal Current reads 3, but 4 was sent")
    assert stop.value.cause is cause and ("accept goals" in str(stop.value)) == (velocity == 0.0)


def test_the_longest_gap_between_two_exchanges_is_remembered(arm: Arm) -> None:
    """It tells whether this program, by sending nothing, may have tripped a watchdog itself."""
    guard = Guard(arm())
    for number, gap in enumerate((0.0, 0.012, 0.004)):
        guard.look(at(number, STILL), gap)
    assert guard._status.longest_gap == 0.012


def test_an_arm_that_is_lowered_may_be_silent_longer(arm: Arm) -> None:
    """Counted from the last exchange that all servos answered, which may be older than the lowering."""
    silent = MISSING._replace(missing=(True, True))
    heard = STILL.time_before_write
    guard = Guard(arm(), lowers_since=heard)
    with pytest.raises(SafetyStop, match="lowering the arm allows 60 ms") as stop:
        for number in range(10, 40):
            guard.look(at(number, silent))
    assert stop.value.cause is Cause.MISSING and 20 < number < 26
    for _ in range(100):
        guard.late(0.01)  # no share of missed deadlines is too large
        guard.look(at(41, STILL))


def test_a_lowering_says_nothing_about_the_torque_of_the_experiment(arm: Arm) -> None:
    with pytest.raises(SafetyStop, match="outside its position limit") as stop:
        Guard(arm(), lowers_since=0.0).look(STILL._replace(position=(9.0, 0.0)))
    assert "peak_torque" not in str(stop.value)


def test_silence_on_a_computer_that_was_late_before_names_it_too(arm: Arm) -> None:
    guard = Guard(arm())
    guard.look(at(0, STILL))
    guard.woke_up(0.0, 0.0011)
    silent = MISSING._replace(missing=(True, True))
    with pytest.raises(SafetyStop, match="other programs keep this computer busy, since this program was running late"):
        for number in range(1, 30):
            guard.look(at(number, silent))
    assert number == round(400 * arm().safety.late_time), "as for missed deadlines"
    guard.look(at(30, STILL))
    guard.woke_up(30 / 400, 0.0011)
    with pytest.raises(SafetyStop, match=r"check its cable and its supply.$"):
        for number in range(31, 60):
            guard.look(at(number, MISSING))
    assert number == 36, "a single servo is itself silent"


def test_a_current_that_does_not_follow(arm: Arm) -> None:
    off = STILL._replace(goal_current=(0.5, 0.0))
    guard = Guard(arm())
    for _ in range(11):
        guard.look(off)
    assert look(guard, off, off) is Cause.NOT_FOLLOWING, "30 ms at full weight"
    guard = Guard(arm())
    follows = STILL._replace(goal_current=(0.5, 0.0), current=(0.5, 0.0))
    for state in [*[off] * 11, *[follows] * 12] * 3:
        guard.look(state)


def test_a_motor_that_only_takes_work_out_turns_the_wrong_way(arm: Arm) -> None:
    braking = STILL._replace(goal_current=(0.4, 0.0), current=(0.4, 0.0), velocity=(-3.0, 0.0))
    falling = [at(n, braking._replace(position=(-1.57 - 0.0075 * n, 0.0))) for n in range(13)]
    assert look(Guard(arm(), PLANNED), *falling) is Cause.WRONG_SIGN
    guard = Guard(arm(), [2.0 * each for each in PLANNED])
    for state in falling:
        guard.look(state)  # a larger goal may have put it in


def test_a_goal_that_falls_is_slew_limited_like_one_that_rises(arm: Arm) -> None:
    guard = Guard(arm())
    assert guard.clamp([-5.0, 0.3]) == pytest.approx([-100 / 400, 100 / 400])
    assert guard.clamp([5.0, -0.3]) == pytest.approx([0.0, 0.0])
    assert guard.clamp([-0.1, 0.2]) == pytest.approx([-0.1, 0.2])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_jump_is_one_in_either_direction_and_what_the_velocity_limit_allows_is_none(arm: Arm, sign: float) -> None:
    most = 1.5 * 20.0 * (1 / 400 + 0.001) + 0.01
    assert look(Guard(arm()), STILL, STILL._replace(position=(-1.57, sign * (most + 0.001)))) is Cause.JUMP
    possible = STILL._replace(position=(-1.57, sign * (most - 0.001)))
    assert look(Guard(arm()), STILL, possible) is Cause.FROZEN, "its velocity says that it stood still"


def test_work_that_another_joint_put_in_may_come_out_at_this_one(arm: Arm) -> None:
    """The elbow drives the shoulder: the work that the shoulder's motor takes out was put in by the elbow."""
    taken = {"goal_current": (0.4, 0.7), "current": (0.4, 0.7), "velocity": (-3.0, 9.0)}

    def states(count: int) -> list[State]:
        position = [(-1.57 - 0.0075 * n, 0.0225 * n) for n in range(count)]
        return [at(n, STILL._replace(position=each, **taken)) for n, each in enumerate(position)]

    guard = Guard(arm(), PLANNED)
    for state in states(60):
        guard.look(state)
    alone = [state._replace(goal_current=(0.4, 0.0), current=(0.4, 0.0)) for state in states(60)]
    guard = Guard(arm(), PLANNED)
    for state in alone[:11]:
        guard.look(state)
    guard.look(alone[11]._replace(goal_current=(0.45, 0.0), current=(0.45, 0.0)))
    assert look(guard, alone[12]) is Cause.WRONG_SIGN


@pytest.mark.parametrize("hertz", [1.0, 4.0])
def test_work_is_what_a_goal_has_done_until_the_next_one(arm: Arm, hertz: float) -> None:
    """At 20 Hz half a period passes in two samples: a motor that drives an arm back and forth only puts work in."""
    guard = Guard(arm(*AT_20_HZ))
    position, velocity = -1.57, 0.0
    for n in range(200):
        goal = 0.2 * sin(tau * hertz * n / 20)
        told = STILL._replace(position=(position, 0.0), velocity=(velocity, 0.0), time_before_write=n / 20)
        guard.look(told._replace(time_after_read=n / 20 + 1e-3, goal_current=(goal, 0.0), current=(goal, 0.0)))
        velocity = 2.0 * goal  # much friction: it follows its motor at once
        position += velocity / 20


def test_a_refusal_needs_no_second_one_at_a_slow_rate(arm: Arm) -> None:
    slow = arm(*AT_20_HZ)
    refused = at(20, MISSING._replace(error=(0, 1)))
    assert look(Guard(slow), STILL, refused) is Cause.MISSING
    guard = Guard(slow)
    for state in (STILL, at(20, MISSING._replace(error=(0, 3))), at(40, STILL), at(60, MISSING)):
        guard.look(state)  # a damaged request, and a lost reply


def test_an_arm_with_a_stabiliser_may_give_out_work(arm: Arm) -> None:
    given = "[stabiliser]\nstiffness = [1.0, 1.0]\ndamping = [0.1, 0.1]\n\n[experiment]\n"
    guard = Guard(arm(("[experiment]\n", given)))
    braking = STILL._replace(goal_current=(0.4, 0.0), current=(0.4, 0.0), velocity=(-3.0, 0.0))
    for n in range(60):
        guard.look(at(n, braking._replace(position=(-1.57 - 0.0075 * n, 0.0))))


def test_lost_torque_is_measured_against_what_the_configuration_plans(arm: Arm) -> None:
    """At 1.8 N m/A and a planned 0.8 N m, a third of the planned current is enough to detect lost torque."""
    off = STILL._replace(goal_current=(0.15, 0.0))
    assert look(Guard(arm()), *[off] * 13) is Cause.NOT_FOLLOWING


@pytest.mark.parametrize(("carried", "said"), [(0.0, "Its torque is off"), (0.9, "another program"), (-0.6, "another")])
def test_a_current_that_does_not_follow_is_off_or_that_of_another(arm: Arm, carried: float, said: str) -> None:
    guard = Guard(arm())
    wrong = STILL._replace(goal_current=(0.3, 0.0), current=(carried, 0.0))
    with pytest.raises(SafetyStop) as stop:
        for number in range(40):
            guard.look(at(number, wrong))
    assert stop.value.cause is Cause.NOT_FOLLOWING
    assert said in str(stop.value)
    assert ("torque is off" in str(stop.value)) == (carried == 0.0)


@pytest.mark.parametrize(
    ("reads", "said"),
    [
        (lambda goal, _: goal - 0.28, "Its torque is not as commanded"),
        (lambda goal, _: 0.07, "stays the same"),
        (lambda goal, n: 1e-3 * (n % 2), "Its torque is off"),
    ],
    ids=["shifted", "stuck", "none"],
)
def test_a_current_that_does_not_follow_is_explained_by_how_it_differs(
    arm: Arm, reads: Callable[[float, int], float], said: str
) -> None:
    """The last reading alone looks like that of a motor without torque."""
    guard, goals = Guard(arm(), PLANNED), [0.2 + 0.1 * (n % 5) / 5 for n in range(400)]
    with pytest.raises(SafetyStop, match=said) as stop:
        for n, (before, goal) in enumerate(pairwise(goals)):
            guard.look(at(n, STILL._replace(goal_current=(0.0, goal), current=(0.0, reads(before, n)))))
    assert stop.value.cause is Cause.NOT_FOLLOWING and "current sensor is wrong" in str(stop.value)


@pytest.mark.parametrize("moves", [0.0, 0.002])
def test_readings_that_stay_the_same_under_other_goals_are_frozen(arm: Arm, moves: float) -> None:
    """At first they answer to the goal, which then rises by less than may be missing from a healthy motor's current."""
    guard, said = Guard(arm(), PLANNED), ""
    try:
        for n in range(400):
            goal, angle = 0.1 + 0.2 * n / 400, moves * (n % 2)
            guard.look(at(n, STILL._replace(goal_current=(0.0, goal), current=(0.0, 0.1), position=(-1.57, angle))))
    except SafetyStop as stop:
        assert stop.cause is Cause.NOT_FOLLOWING
        said = str(stop)
    wanted = "exactly the same position, velocity and current (0.100 A) for 318 ms, although its goal has changed by"
    assert (wanted in said) == (moves == 0.0), said


def test_late_deadlines_and_a_gap_that_trips_watchdogs(arm: Arm) -> None:
    guard = Guard(arm())
    for _ in range(20):
        guard.late()
    with pytest.raises(SafetyStop, match="21 deadlines in a row"):
        guard.late()
    with pytest.raises(SafetyStop, match="120 ms passed between two commands"):
        Guard(arm()).look(STILL, 0.12)


def test_an_exchange_between_two_samples_does_not_make_up_for_a_missed_deadline(arm: Arm) -> None:
    guard = Guard(arm())
    for number in range(20):
        guard.late()
        guard.look(at(number, STILL), between=True)
    with pytest.raises(SafetyStop, match="21 deadlines in a row"):
        guard.late()


@pytest.mark.parametrize(("took", "allowed"), [(0.0039, 15), (0.0041, 50)])
def test_an_exchange_that_ends_1_ms_after_its_patience_shows_a_busy_computer(
    arm: Arm, took: float, allowed: int
) -> None:
    """Silence of all servos may then be due to the computer."""
    guard = Guard(arm(), patience=0.003)
    guard.look(STILL._replace(time_after_read=took))
    silent = MISSING._replace(missing=(True, True), position=(nan, nan), velocity=(nan, nan), current=(nan, nan))
    with pytest.raises(SafetyStop, match=f"allows {allowed} ms"):
        for number in range(1, 40):
            guard.look(at(number, silent))


def test_late_deadlines_stop_before_a_short_watchdog_acts(arm: Arm) -> None:
    guard = Guard(arm(("[experiment]\n", "[safety]\nwatchdog = 0.04\n\n[experiment]\n")))
    for _ in range(12):
        guard.late()
    with pytest.raises(SafetyStop, match="13 deadlines in a row were missed: 32 ms passed without a command"):
        guard.late()


def test_deadlines_missed_again_and_again_stop_though_never_many_in_a_row(arm: Arm) -> None:
    guard = Guard(arm())
    with pytest.raises(SafetyStop, match=r"More than 20 % of the deadlines have been missed.*latency") as stop:
        for _ in range(40):
            guard.late()
            guard.look(STILL)
    assert stop.value.cause is Cause.LATE
    guard = Guard(arm())
    for _ in range(100):  # one stall of ten deadlines, then a second without any
        for _ in range(10):
            guard.late()
        for _ in range(400):
            guard.look(STILL)
    guard = Guard(arm())
    for _ in range(500):  # one missed deadline in eight
        guard.late()
        for _ in range(7):
            guard.look(STILL)


def test_motion_before_the_start(arm: Arm) -> None:
    for is_left, advice in (
        (False, "still swinging, .* wait until"),
        (True, r"still swinging .* raise safety\.rest_time \(3 s"),
    ):
        guard = Guard(arm(), left_by_a_run=is_left)
        guard.look_at_rest(STILL)
        with pytest.raises(SafetyStop, match=rf"'elbow' \(ID 2.*moved before the start: \+0\.060.*{advice}") as stop:
            guard.look_at_rest(STILL._replace(position=(-1.57, 0.06)))
        assert stop.value.cause is Cause.EARLY_MOTION


@pytest.mark.parametrize(("velocity", "said"), [(0.02, "encoder and magnet"), (-0.2, "a hand or a cable pushes")])
def test_a_joint_that_is_elsewhere_before_the_start_has_jumped_unless_it_moves(
    arm: Arm, velocity: float, said: str
) -> None:
    guard = Guard(arm())
    guard.rests_at(STILL.position)
    with pytest.raises(SafetyStop) as stop:
        guard.look_at_rest(STILL._replace(position=(-1.57, 1.57), velocity=(0.0, velocity)))
    assert said in str(stop.value) and f"{velocity:+.2f} rad/s" in str(stop.value)


def test_an_unprotected_servo_stops_the_arm_but_not_its_lowering(arm: Arm) -> None:
    armed = round(arm().safety.watchdog / WATCHDOG_UNIT)
    guard, lowering = Guard(arm()), Guard(arm(), lowers_since=0.0)
    for each in (guard, lowering):
        each.watchdog_reads(1, armed)
    lowering.watchdog_reads(1, 0)
    with pytest.raises(SafetyStop, match=r"ID 2.* Bus Watchdog reads 0 but was set to 4"):
        guard.watchdog_reads(1, 0)
    for each in (guard, lowering):
        with pytest.raises(SafetyStop, match="its watchdog tripped"):
            each.watchdog_reads(1, 255)


def at_rest(guard: Guard, noise: float) -> list[str]:
    """Let the second joint's current be this noisy before the start; return what the guard says about it."""
    random = Random(2)
    guard.rests_at(STILL.position)
    for number in range(200):
        state = at(number, STILL._replace(current=(0.0, random.gauss(0.0, noise))))
        guard.look(state)
        guard.measure_noise(state)
    return guard.noise_is_known()


def test_a_noisy_current_reading_is_named_and_refused_only_if_it_hides_lost_torque(arm: Arm) -> None:
    assert at_rest(Guard(arm()), 0.001) == []
    guard = Guard(arm(), (0.05, 0.05))
    (said,) = at_rest(guard, 0.05)
    assert re.search(
        r"ID 2.*is noisy: 0\.0[45]\d* A RMS .* cannot be detected within 0\.1 s at goals below 0\.1\d A", said
    )
    later = Guard(arm(), (0.05, 0.05), noise=guard.current_noise)
    for each in (guard, later):
        for number in range(40):
            each.look(at(500 + number, STILL._replace(goal_current=(0.0, -0.02), current=(0.0, 0.06))))
    assert look(Guard(arm(), (0.05, 0.05)), *[at(n, STILL._replace(current=(0.0, 0.06))) for n in range(20)])
    with pytest.raises(SafetyStop, match=r"its current reading is noisy: .* A RMS.* 25 % of current_limit"):
        at_rest(Guard(arm()), 2.0)


def test_motion_that_does_not_repeat_may_need_less_torque(arm: Arm) -> None:
    with pytest.raises(SafetyStop, match=r"its load has changed.* Lower experiment\.peak_torque") as stop:
        Guard(arm()).does_not_repeat(1, 0.5)
    assert stop.value.cause is Cause.UNLIKE_BEFORE


def test_commands_are_clamped_slew_limited_and_never_nan(arm: Arm) -> None:
    guard = Guard(arm())
    first = guard.clamp([5.0, -0.1])
    assert first == pytest.approx([100 / 400, -0.1]), "A: 100 A/s at 400 per second"
    for _ in range(10):
        last = guard.clamp([5.0, -5.0])
    assert last == pytest.approx([1.2, -0.8])
    for wrong in (nan, inf, -inf):
        with pytest.raises(SafetyStop, match="is not a finite number"):
            guard.clamp([wrong, 0.0])
    for count in (1, 3):
        with pytest.raises(ValueError, match=f"{count} goals for 2 joints"):
            guard.clamp([0.1] * count)


def test_a_look_costs_little_more_than_a_hundred_additions(arm: Arm) -> None:
    """benchmarks/safety/guard.py measures the time; this test detects a slow check on a machine of any speed."""
    guard = Guard(arm())
    moving = STILL._replace(goal_current=(0.1, 0.1), current=(0.1, 0.1), velocity=(0.02, 0.02))

    def look() -> None:
        guard.clamp((0.1, 0.1))
        guard.look(moving, 0.0025)

    def add() -> None:
        total = 0.0
        for each in range(100):
            total += each

    # Short rounds, so that on a busy machine some of each are not interrupted.
    rounds = [(timeit(look, number=20), timeit(add, number=20)) for _ in range(500)]
    assert min(looked for looked, _ in rounds) < 3 * min(added for _, added in rounds)


def test_a_joint_that_a_run_left_beyond_its_limit_may_move_in_and_no_farther_out(arm: Arm) -> None:
    config = arm()
    high = config.joints[1].position_limit[1]

    def at(*beyond: float) -> list[State]:
        return [STILL._replace(position=(-1.57, high + each)) for each in beyond]

    assert look(Guard(config), *at(0.006)) is Cause.POSITION, "a person put it there"
    guard = Guard(config, left_by_a_run=True)
    for state in at(0.006, 0.007, 0.004, -0.002):
        guard.look(state)
    assert look(guard, *at(0.001)) is Cause.POSITION, "it was inside"
    assert look(Guard(config, left_by_a_run=True), *at(0.006, 0.013, 0.02)) is Cause.POSITION
    assert look(Guard(config, left_by_a_run=True), *at(0.6)) is Cause.POSITION, "an arm that fell"


def memory(guard: Guard, check: str) -> Any:
    """What a check remembers of the first joint."""
    return guard._joints[0][check]


@pytest.mark.parametrize("error", [0, 3])
def test_how_long_an_exchange_took_beyond_the_shortest_is_how_unsure_its_time_is(arm: Arm, error: int) -> None:
    """A joint at 1 rad/s: its position is unsure by as many radians. An error of the other joint changes nothing."""
    guard = Guard(arm())
    moving = STILL._replace(velocity=(1.0, 0.0), error=(0, error), missing=(False, bool(error)))
    unsure = []
    for number, took in enumerate((0.001, 0.0015, 0.0008, 0.0009)):
        now = number / 400
        position = (STILL.position[0] + now, 0.0)
        guard.look(moving._replace(position=position, time_before_write=now, time_after_read=now + took))
        unsure.append(float(memory(guard, "consistency")["unknown"]))
    assert unsure == pytest.approx([0.0, 0.0005, 0.0005, 0.0006])


@pytest.mark.parametrize(("gap", "compared"), [(2.9, 1), (3.1, 0)])
def test_after_three_intervals_position_and_velocity_are_compared_anew(arm: Arm, gap: float, compared: int) -> None:
    guard = Guard(arm())
    guard.look(at(1, STILL))
    guard.look(at(1, STILL)._replace(time_before_write=(1 + gap) / 400, time_after_read=(1 + gap) / 400 + 0.001))
    assert memory(guard, "consistency")["steps"]["age"] == pytest.approx(compared * gap / 400)


def test_a_punctual_reply_after_a_late_one_and_a_missing_one_stands_for_both_intervals(arm: Arm) -> None:
    guard = Guard(arm())
    off = STILL._replace(goal_current=(0.5, 0.0))
    silent = MISSING._replace(missing=(True, True))
    for when, state in ((0.9, off), (1.0, silent), (2.0, off)):
        guard.look(state._replace(time_before_write=when / 400, time_after_read=when / 400 + 0.001))
    assert memory(guard, "following")["differs_for"] == pytest.approx(2 / 400)


def test_a_joint_whose_first_reply_is_missing_counts_from_then(arm: Arm) -> None:
    guard = Guard(arm())
    guard.look(at(400_000, MISSING._replace(missing=(True, True))))
    guard.look(at(400_001, STILL._replace(current=(0.5, 0.0))))
    assert memory(guard, "following")["differs_for"] == pytest.approx(2 / 400)


def test_the_status_of_one_joint_among_others_without_one(arm: Arm) -> None:
    config = arm()
    armed = round(config.safety.watchdog / 0.02)
    fine = STILL._replace(status=(None, Status(armed, 0.0, 1.0, torque=True, hardware_error=0)))
    Guard(config).look(fine)
    off = STILL._replace(status=(None, Status(armed, 0.0, 1.0, torque=False, hardware_error=0)))
    with pytest.raises(SafetyStop, match=r"Joint 'elbow'.* has lost its torque") as stop:
        Guard(config).look(off)
    assert stop.value.cause is Cause.TORQUE_OFF


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(("beyond", "stops"), [(0.45, False), (0.55, True)])
def test_an_arm_that_a_run_left_beyond_either_limit_may_start_a_little_outside(
    arm: Arm, side: int, beyond: float, stops: bool
) -> None:
    limits = arm().joints[0].position_limit
    outside = STILL._replace(position=(limits[side] + (beyond if side else -beyond), 0.0))
    guard = Guard(arm(), left_by_a_run=True)
    if stops:
        assert look(guard, outside) is Cause.POSITION
    else:
        guard.look(outside)


@pytest.mark.parametrize(
    ("carried", "velocity", "cause"),
    [
        (0.1, 4.6, Cause.OUT_OF_VOLTAGE),
        (0.0, 4.8, Cause.OUT_OF_VOLTAGE),
        (0.0, 2.9, Cause.NOT_FOLLOWING),  # the supply could drive this current: its torque is off
        (0.1, 1.0, Cause.NOT_FOLLOWING),
        (-0.6, 4.6, Cause.NOT_FOLLOWING),
    ],
)
def test_a_current_behind_its_goal_near_no_load_speed_is_the_supplys(
    arm: Arm, carried: float, velocity: float, cause: Cause
) -> None:
    fast = STILL._replace(goal_current=(0.0, 0.3), current=(0.0, carried), velocity=(0.0, velocity))
    states = [at(n, fast._replace(position=(-1.57, velocity * n / 400))) for n in range(40)]
    guard = Guard(arm())
    with pytest.raises(SafetyStop) as stop:
        for state in states:
            guard.look(state)
    assert stop.value.cause is cause
    said = str(stop.value)
    assert ("lower velocity_limit" in said) == (cause is Cause.OUT_OF_VOLTAGE)
    if cause is Cause.OUT_OF_VOLTAGE:
        assert said.index("Check the motor's wiring first") < said.index("lower velocity_limit")


@pytest.mark.parametrize(
    ("carried", "velocity", "lacking", "is_supply"),
    [
        (0.1, 4.6, 0.4, True),
        (0.1, 4.6, 2.0, False),  # explains too little
        (0.1, 4.6, -0.4, False),
        (0.1, 1.0, 0.4, False),
        (0.29, 4.6, 0.4, False),
    ],
)
def test_a_torque_that_the_supply_cannot_drive_explains_what_a_joint_lacks(
    arm: Arm, carried: float, velocity: float, lacking: float, is_supply: bool
) -> None:
    fast = STILL._replace(goal_current=(0.0, 0.3), current=(0.0, carried), velocity=(0.0, velocity))
    recent = [at(n, fast) for n in range(0, 40, 20)]
    if is_supply:
        with pytest.raises(SafetyStop, match=r"carries 0\.100 A .* cannot drive more") as stop:
            Guard(arm()).look_at_supply(1, lacking, recent)
        assert stop.value.cause is Cause.OUT_OF_VOLTAGE
    else:
        Guard(arm()).look_at_supply(1, lacking, recent)


def not_followed(
    guard: Guard, carried: float, velocity: float, *, volt: float = nan, held: float | None = None
) -> SafetyStop:
    """The stop because joint 2 carries a current other than its goal, 0.3 A."""
    turning = STILL._replace(goal_current=(0.0, 0.3), current=(0.0, carried), velocity=(0.0, velocity))
    guard.look(STILL._replace(slow=NOTHING_SLOW._replace(voltage=(volt, volt))))
    goal = 0.3 if held is None else held
    told = tuple(Status(4, each, 0.0, torque=True, hardware_error=0) for each in (0.0, goal))
    with pytest.raises(SafetyStop) as stop:
        for n in range(1, 60):
            state = at(n, turning._replace(position=(-1.57, velocity * n / 400)))
            guard.look(state._replace(status=told) if held is not None and n == 6 else state)
    return stop.value


@pytest.mark.parametrize(("volt", "is_supply"), [(12.0, False), (9.5, True), (nan, True)])
def test_the_supply_is_blamed_only_if_it_cannot_drive_more_at_this_speed(
    arm: Arm, volt: float, is_supply: bool
) -> None:
    """At 3.05 rad/s the winding of an XM430-W350 with 0.12 A has 8.2 V: at 12 V the rest would drive 0.8 A."""
    stop = not_followed(Guard(arm()), 0.12, 3.05, volt=volt)
    said = str(stop)
    # The pilot lowers the speed for the first of these causes only.
    assert stop.cause is (Cause.OUT_OF_VOLTAGE if is_supply else Cause.GOALS_CHANGED)
    assert ("its supply cannot drive more" in said) == is_supply
    assert "its current sensor is wrong" in said
    assert ("goals are being altered in transit" in said) == (not is_supply)
    assert "carries 0.120 A instead of the commanded 0.300 A" in said


@pytest.mark.parametrize(
    ("earlier", "volt", "is_supply"), [(9.5, 12.0, True), (12.0, nan, False), (12.0, 9.5, True), (nan, 12.0, False)]
)
def test_the_lowest_voltage_read_so_far_counts(arm: Arm, earlier: float, volt: float, is_supply: bool) -> None:
    guard = Guard(arm())
    guard.look(STILL._replace(slow=NOTHING_SLOW._replace(voltage=(earlier, earlier))))
    stop = not_followed(guard, 0.12, 3.05, volt=volt)
    assert (stop.cause is Cause.OUT_OF_VOLTAGE) is is_supply


def test_another_goal_in_the_servo_is_named_before_the_supply(arm: Arm) -> None:
    said = str(not_followed(Guard(arm()), 0.12, 3.6, volt=12.0, held=0.12))
    assert "Its goal register reads 0.120 A" in said and "another program is commanding it" in said
    assert "supply" not in said


def test_errors_reported_with_values_stop_when_they_are_several_in_a_row(arm: Arm) -> None:
    guard, wrong = Guard(arm()), STILL._replace(error=(0, 4))
    for number, state in enumerate((STILL, wrong, wrong, STILL, wrong)):
        guard.look(at(number, state))
    guard.look(at(5, wrong))
    with pytest.raises(SafetyStop, match=r"'elbow'.*data range error.*3 times in a row") as stop:
        guard.look(at(6, wrong))
    assert stop.value.cause is Cause.ERRORS
