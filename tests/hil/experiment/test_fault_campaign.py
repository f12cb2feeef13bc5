"""Random faults in every bundled configuration and rate; benchmarks/faults.py draws thousands."""

from dataclasses import replace
from itertools import chain
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.fault_campaign.arms import MIXED, RATES, Setting, names, settings
from benchmarks.fault_campaign.attack import Attack, Kind
from benchmarks.fault_campaign.campaign import Outcome, inject_drawn, play, prepare
from benchmarks.fault_campaign.draw import Drawn
from benchmarks.fault_campaign.judge import (
    TRIP_MS,
    addressed,
    judge_words,
    received,
    since_again,
    stopped_unwatched,
    was_built_so,
)
from benchmarks.fault_campaign.twin import has_healthy_twin, lagging, wired_otherwise
from benchmarks.fault_campaign.witness import CURRENT_MODE, PWM_MODE, Witness
from benchmarks.faults import campaign, figures
from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode, servo_model
from hil.experiment.checks.apart import causes_of_standstill
from hil.experiment.checks.swapped import swapped_advice
from hil.experiment.status_check import OLD_REPLIES

INJECTIONS = 300

PERIOD_S = 0.6
"""Period of the multisines: shorter than in the script's campaign, to save processor time. Whole runs take 3 to 4 s."""

PARTS = 2
"""Number of tests that share them, so that they run side by side."""

NAMED = 0.95

UNSAFE = frozenset({("xc330_two_link", 100, "stuck_joint")})
"""Draws known to be unsafe, by configuration, rate [Hz] and faults; the aim is none.

This joint jams as it turns round, 1.0 s after torque came on. Friction might as well hold it, until the torque has
changed by more than that; then the jam is found, 0.227 s instead of 0.1 s after the joint is away from where it would
be (docs/safety.md).
"""

RATES_IN_TURN = ((100, 1000), (100, 400), (20, 400))
"""Rates of every first, second and third configuration [Hz]."""


def key(outcome: Outcome) -> tuple[str, int, str]:
    return outcome.setting.name, outcome.setting.rate, " and ".join(outcome.drawn.kinds)


def chosen(part: int) -> list[Setting]:
    """Each of a part's bundled configurations at two rates, in turn; the mixed arm, at one, is in the last part."""
    turns = [RATES_IN_TURN[number % len(RATES_IN_TURN)] for number in range(len(names()))]
    bundled = [[Setting(name, rate) for rate in turn] for name, turn in zip(names(), turns, strict=True)]
    mixed = [Setting(MIXED, 100)] * (part == PARTS - 1)
    return [*chain.from_iterable(bundled[part::PARTS]), *mixed]


@pytest.mark.long
@pytest.mark.parametrize("part", range(PARTS))
def test_random_faults_end_safe_recorded_restored_and_named(part: int) -> None:
    outcomes, left_out = campaign(chosen(part), INJECTIONS // PARTS, jobs=1, period=PERIOD_S, even=False)
    assert not left_out, left_out
    bad = [each for each in outcomes if each.unreadable or each.not_restored or each.verdict.misleading]
    bad += [each for each in outcomes if (each.verdict.unsafe and key(each) not in UNSAFE) or each.beyond_limit]
    assert not bad, "\n\n".join(map(str, bad))
    counted = figures(outcomes)
    assert counted["unnamed"] <= (1 - NAMED) * counted["stopped"]
    assert 0.3 * len(outcomes) < counted["stopped"] < 0.9 * len(outcomes), "it includes stops and runs that continue"


def test_every_shipped_configuration_is_in_it_at_every_rate() -> None:
    every = [*names(), MIXED]
    assert {(each.name, each.rate) for each in settings()} == {(name, rate) for name in every for rate in RATES}
    assert len(names()) >= 11


def test_a_limit_lowered_before_a_kill_is_restored_once_it_has_been_set_back() -> None:
    attacks = Attack(Kind.LOWERED_LIMIT, 0.8, np.inf, servo=1, amount=0.1), Attack(Kind.KILLED, 0.85, np.inf)
    assert inject_drawn(prepare(Setting("fake_pendulum", 100), 1.0), Drawn(attacks, ()), 1).not_restored == ()


def test_a_healthy_arm_that_mixes_servos_with_and_without_goal_current_is_not_stopped() -> None:
    ready = prepare(Setting(MIXED, 100), PERIOD_S)
    modes = [joint.drive_mode for joint in ready.config.joints]
    assert modes == [Mode.PWM, Mode.CURRENT]
    assert np.ptp(received(ready.config, ready.undisturbed).angle, axis=0).min() > 0.05


JUMP = "reports an angle that changed by 0.3 rad within 5 ms; its velocity limit allows at most 0.1. Check the encoder."
CONTRADICTION = (
    "reports a velocity that does not fit its position: one of the two readings is frozen. Check the encoder."
)
NO_TORQUE = "carries 0.000 instead of the commanded 0.300. Its torque is off."
UNLIKE_ANY = (
    "does not move like any arm consistent with the data. Its encoder has failed, something is pushing or holding it."
)
SWAPPED = f"reports an angle that changed by 0.3 rad within 5 ms. {swapped_advice(1, 2)}"
STANDSTILL = causes_of_standstill(Joint("elbow", 2, servo_model("XL430-W250"), mode=Mode.PWM))
TWICE = "missed 6 replies in a row. Replies did arrive, but too late or twice."


@pytest.mark.parametrize(
    ("kind", "field", "right", "wrong"),
    [
        (Kind.PUSHED, "state", UNLIKE_ANY, JUMP),
        (Kind.WEAK, "state", NO_TORQUE, CONTRADICTION),
        (Kind.HOMING_MOVED, "state", "Check whether another program is changing its settings.", TWICE),
        (Kind.LOWERED_LIMIT, "state", "its Current Limit is 236, but current_limit = 1.2 A needs 447", CONTRADICTION),
        (Kind.DEAF, "state", "does not accept goals: some are lost. Goals are being lost in transit.", CONTRADICTION),
        (Kind.GOAL_FIGHT, "state", "Another program is commanding it.", "stands still. Something is blocking it."),
        (Kind.BIAS, "position", JUMP, NO_TORQUE),
        (Kind.BIAS, "current", NO_TORQUE, JUMP),
        (Kind.REPEAT, "state", TWICE, "its reply is another servo's."),
        (Kind.REPLAY, "state", OLD_REPLIES[1], "its reply is another servo's."),
        (Kind.CONSTANT, "current", "carries 0.3 A. Its current reading stays the same, its sensor is wrong.", JUMP),
        (Kind.WATCHDOG_LONG, "state", "stops by itself later than intended: its Bus Watchdog reads 127", JUMP),
        (Kind.SHADOWED, "state", "changed the settings (Secondary(Shadow) ID is 1 and was 255)", TWICE),
        (Kind.IDS_SWAPPED, "state", "Requests to ID 1 are answered by ID 2: the servos' IDs are mixed up.", TWICE),
        (Kind.WEAK, "state", f"is not moving. {STANDSTILL}", CONTRADICTION),
        (Kind.OBSTACLE, "state", f"is not moving. {STANDSTILL}", NO_TORQUE),
        (Kind.IDS_SWAPPED, "state", SWAPPED, TWICE),
        (Kind.SWAP, "state", SWAPPED, TWICE),
        (Kind.LAG, "velocity", "is at 1 rad, outside its position limit", "Lower velocity_limit, or raise the voltage"),
    ],
)
def test_a_message_that_names_another_fault_is_misleading(kind: Kind, field: str, right: str, wrong: str) -> None:
    drawn = Drawn((Attack(kind, 1.0, 2.0, field=field),), ())
    assert judge_words(drawn, right) == (True, False)
    assert judge_words(drawn, wrong) == (False, True)


@pytest.mark.parametrize(("mode", "felt", "sensed"), [(PWM_MODE, -0.7, 0.7), (CURRENT_MODE, 0.3, -0.3)])
def test_a_motor_that_is_turned_round_brakes_itself_as_any_motor_does(mode: int, felt: float, sensed: float) -> None:
    """At 2 rad/s, -0.3 A at 0.2 V from 1 ohm and 0.25 V s: turned round it induces -0.5 V instead of 0.5 V."""
    model = SimpleNamespace(back_emf_v_s=0.25, resistance_ohm=1.0)
    plant = SimpleNamespace(joints=1, position=(0.0,), velocity=(2.0,), current=(felt,))
    witness = Witness(SimpleNamespace(plant=plant, _servos=[], time=0.0))  # type: ignore[arg-type]
    witness._servos = [SimpleNamespace(operating_mode=mode, model=model)]  # type: ignore[list-item]
    witness.disturb(0, Attack(Kind.WEAK, 1.0, 2.0, amount=-1.0))
    assert witness._driven_by((-0.3,), 1.5) == pytest.approx([felt])
    assert witness.current == pytest.approx((sensed,))


def test_a_message_may_also_name_a_harmless_change_but_not_only_that() -> None:
    late = Attack(Kind.SPLIT, 1.0, 2.0, amount=0.03)
    drawn = Drawn((Attack(Kind.RAISED_LIMIT, 0.5, 0.5), late), ())
    changed = (
        "Another program changed the settings of a servo during the run (joint 2: Current Limit is 480 and was 240)."
    )
    cause = "missed 6 replies in a row. Check the adapter and whether other programs keep this computer busy."
    assert judge_words(drawn, f"{cause} {changed}") == (True, False)
    assert judge_words(drawn, changed) == (False, True), "it is true, but not why the run was stopped"


def test_a_healthy_twin_is_found_for_a_healthy_arm_and_a_stuck_one_but_not_for_one_that_freezes_in_motion() -> None:
    ready = prepare(Setting("fake_pendulum", 100), 1.0)
    heard = received(ready.config, ready.undisturbed)
    assert has_healthy_twin(ready.config, heard, 2.0)
    stuck = replace(heard, angle=np.full_like(heard.angle, heard.angle[0]), velocity=np.zeros_like(heard.velocity))
    assert has_healthy_twin(ready.config, stuck, 2.0), "its friction may be as large"
    moves = heard.time[:, None] < 1.2
    at = int(moves.sum())
    frozen = replace(
        heard, angle=np.where(moves, heard.angle, heard.angle[at]), velocity=np.where(moves, heard.velocity, 0.0)
    )
    assert has_healthy_twin(ready.config, frozen, 1.2) and not has_healthy_twin(ready.config, frozen, 1.3)


def lags_from(since: float, lag: float) -> bool:
    """Whether a healthy arm is found for one whose velocity lags by `lag` from `since` on [s]."""
    ready = prepare(Setting("fake_pendulum", 100), 1.0)
    heard = received(ready.config, ready.undisturbed)
    late = np.where(heard.time < since, heard.velocity[:, 0], lagging(heard.velocity[:, 0], heard.time, lag))
    return has_healthy_twin(ready.config, replace(heard, velocity=late[:, None]), 2.4)


def test_a_healthy_servo_s_velocity_may_lag_but_neither_by_any_time_nor_more_than_before() -> None:
    assert lags_from(0.0, 0.025)
    assert not lags_from(0.0, 0.15), "more than the program accepts of any servo"
    assert not lags_from(1.4, 0.1)


def test_servos_wired_the_other_way_round_are_a_healthy_arm_unless_that_shows_in_the_replies() -> None:
    """IDs swapped before the first reading leave no trace; swapped later, the readings jump."""
    ready = prepare(Setting("fake_two_link", 100), 1.0)
    heard = received(ready.config, ready.undisturbed)
    swapped = wired_otherwise(ready.config, heard)
    assert swapped is not None
    back = wired_otherwise(ready.config, swapped)
    assert back is not None and np.allclose(back.angle, heard.angle)
    # What the program receives under the IDs that the file names, if each servo answers with the other one's.
    other = replace(
        heard,
        angle=heard.angle[:, ::-1] + np.array([-np.pi / 2, np.pi / 2]),
        velocity=heard.velocity[:, ::-1],
        commands=heard.commands[:, ::-1],
    )
    assert has_healthy_twin(ready.config, other, 2.0)
    later = heard.time[:, None] > 1.2
    mixed = replace(
        heard,
        angle=np.where(later, other.angle, heard.angle),
        velocity=np.where(later, other.velocity, heard.velocity),
    )
    assert not has_healthy_twin(ready.config, mixed, 2.0)


def test_arms_of_different_servos_or_with_a_description_are_not_wired_the_other_way_round() -> None:
    ready = prepare(Setting("fake_two_link", 100), 1.0)
    config, heard = ready.config, received(ready.config, ready.undisturbed)
    described = config.model_copy(update={"arm": config.arm.model_copy(update={"link_lengths": [0.147, 0.18]})})
    assert wired_otherwise(config, heard) is not None and wired_otherwise(described, heard) is None
    assert wired_otherwise(prepare(Setting(MIXED, 100), PERIOD_S).config, heard) is None


@pytest.mark.parametrize(
    ("name", "start", "more", "is_alike"),
    [
        *(("fake_inverted", 0.008, (), True), ("fake_inverted", 0.14, (), False)),
        *(("fake_inverted", 0.008, (Attack(Kind.CLOCK_SET, 1.0, 1.0),), False), (MIXED, 0.008, (), False)),
    ],
    ids=["nothing was written", "limits were written", "another fault", "different servos"],
)
def test_equal_servos_that_swap_their_ids_at_the_same_angle_are_an_arm_that_was_built_so(
    name: str, start: float, more: tuple[Attack, ...], is_alike: bool
) -> None:
    ready = prepare(Setting(name, 100), PERIOD_S)
    drawn = Drawn((Attack(Kind.IDS_SWAPPED, start, start), *more), ())
    assert was_built_so(ready.config, drawn, ready.undisturbed) == is_alike
    apart = replace(ready.undisturbed, record=ready.undisturbed.record.copy())
    apart.record["position"][0, 0] += 0.1
    assert not was_built_so(ready.config, drawn, apart), "the readings of both joints change"


@pytest.mark.parametrize(("after", "nobody"), [(-0.31, False), (-0.01, True), (0.03, True), (0.2, False)])
def test_nobody_can_end_the_current_while_the_program_is_stopped_and_the_watchdogs_are_newly_disarmed(
    after: float, nobody: bool
) -> None:
    stop = Attack(Kind.STALL, 1.0 + after, 1.0 + after, amount=0.3)
    assert stopped_unwatched(Drawn((Attack(Kind.WATCHDOG_OFF, 1.0, 1.0), stop), ())) == (
        [pytest.approx((0.98 + after, 1.3 + after))] if nobody else []
    )


def test_a_servo_that_has_taken_another_s_id_does_as_told_if_it_obeys_that_id() -> None:
    ready = prepare(Setting("fake_two_link", 100), 1.0)
    config, record = ready.config, ready.undisturbed.record[:3].copy()
    record["id"] = [[1, 2], [2, 1], [1, 200]]
    record["goal"] = [[10, 20], [30, 40], [50, 60]]
    assert addressed(config, record, 0)["goal"].tolist() == [10, 40, 50]
    assert addressed(config, record, 1)["goal"].tolist() == [20, 30, 60], "if none has the ID, its own servo counts"


@pytest.mark.parametrize(
    ("ended", "again", "since", "later"),
    [
        *((1.08, 1.2, 1.18, 0.0), (1.08, 0.9, 1.0, 0.0), (1.17, 1.2, 1.0, 0.0), (1.12, 1.3, 1.0, 0.0)),
        *((1.08, 1.1, 1.0, 0.0), (1.08, 1.16, 1.0, 0.0), (1.08, 1.2, 1.0, 0.2)),
    ],
    ids=[
        *("ended in time", "before the reason", "has not ended", "ended too late", "ended just before"),
        *("off as long as a goal of zero", "on again for another reason"),
    ],
)
def test_torque_that_another_program_switches_on_is_a_new_reason(
    ended: float, again: float, since: float, later: float
) -> None:
    driven = np.concatenate((np.arange(0.5, ended, 1e-3), np.arange(again + later, again + later + 0.05, 1e-3)))
    assert since_again(driven, 1.0, [again]) == pytest.approx(since)


def test_watchdogs_disarmed_while_the_program_is_suspended_have_tripped_before() -> None:
    """If the attack took effect only when the program resumes, it would disarm the watchdogs before they trip."""
    ready = prepare(Setting("fake_two_link", 100), PERIOD_S)
    stop, attack = Attack(Kind.SUSPENDED, 1.0, 1.0, amount=2.0), Attack(Kind.WATCHDOG_OFF, 2.0, 2.0)
    story, _, changed = play(ready, Drawn((stop, attack), ()), 0)
    time, driven = story.record["time"][:, 0], story.record["driven"][:, 0]
    trips = 1.0 + ready.config.safety.watchdog + 1e-3 * TRIP_MS
    assert driven[time < 1.0].any() and not driven[(time > trips) & (time < 3.0)].any()
    assert not changed
