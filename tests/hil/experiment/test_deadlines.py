"""Missed deadlines and missing replies: the exact counts and times at which they stop the arm."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config.schema import Config, load_config
from hil.errors import Cause, SafetyStop
from hil.experiment.deadlines import Deadlines
from hil.experiment.silence import Silence
from hil.plan.silence import Limit, is_missing_too_long, late_limit, missing_limit
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
RATE = 400
FAKE = load_config(CONFIGS / "fake_two_link_ideal.toml")


def safety(lines: str) -> tuple[str, str]:
    return "[experiment]\n", f"[safety]\n{lines}\n\n[experiment]\n"


def said_by(action: Callable[[], None]) -> str:
    with pytest.raises(SafetyStop) as stop:
        action()
    assert stop.value.cause is Cause.LATE
    return str(stop.value)


def test_deadlines_missed_in_a_row_count_by_their_number_and_by_the_time_since_the_last_command(arm: Arm) -> None:
    deadlines = Deadlines(arm())
    for _ in range(20):
        deadlines.missed()  # 20 intervals of 2.5 ms are the 50 ms allowed
    said = said_by(deadlines.missed)
    assert (
        "21 deadlines in a row were missed: 52 ms passed without a command; safety.late_time = 0.05 s allows 50 ms"
        in said
    )
    assert "atchdog" not in said
    deadlines = Deadlines(arm())
    deadlines.missed(0.0499)
    assert "20 deadlines in a row were missed: 51 ms passed without" in said_by(lambda: deadlines.missed(0.051))


def test_a_sample_on_time_begins_the_row_anew(arm: Arm) -> None:
    deadlines = Deadlines(arm())
    for _ in range(3):
        for _ in range(20):
            deadlines.missed()
        deadlines.met()


def test_what_the_watchdogs_did_during_a_gap(arm: Arm) -> None:
    deadlines = Deadlines(arm())
    deadlines.check_gap(0.0799)
    acted = "Watchdogs that were still armed cut the current after 80 ms."
    said = said_by(lambda: deadlines.check_gap(0.08))
    assert "This program stalled: 80 ms passed between two commands" in said and said.endswith(acted)
    assert "1.5 s passed" in said_by(lambda: deadlines.check_gap(1.5))
    assert "1.0 s passed" in said_by(lambda: deadlines.check_gap(1.0))
    assert "999 ms passed" in said_by(lambda: deadlines.check_gap(0.999))
    assert said_by(lambda: deadlines.missed(0.08)).endswith(acted)


def rows_until_stop(deadlines: Deadlines, missed: int, met: int) -> int:
    """Number of rows of missed and met deadlines until too many are missed."""
    for row in range(200):
        try:
            for _ in range(missed):
                deadlines.missed()
            for _ in range(met):
                deadlines.met()
        except SafetyStop as stop:
            assert "More than 20 % of the deadlines have been missed" in str(stop) and "for 400 Hz" in str(stop)
            return row
    return -1


@pytest.mark.parametrize(
    ("missed", "met", "rows"),
    [
        (1, 5, -1),  # exactly a fifth
        (1, 1, 12),  # 0.8 more each time, until 10 are reached: half of the 50 ms allowed
        (1, 4, 46),
        (2, 5, 9),
        (20, 5, 9),  # of one stall only two count
        (3, 11, -1),
    ],
)
def test_which_share_of_missed_deadlines_stops(arm: Arm, missed: int, met: int, rows: int) -> None:
    assert rows_until_stop(Deadlines(arm()), missed, met) == rows


def test_at_slow_rates_five_count_as_too_many(arm: Arm) -> None:
    slow = Deadlines(arm(("rate = 400.0", "rate = 50.0"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]")))
    for _ in range(6):  # 0.8 more each time
        slow.missed(0.02)
        slow.met()
    slow.missed(0.02)
    with pytest.raises(SafetyStop, match=r"More than 20 %"):
        slow.met()


@pytest.mark.parametrize(
    ("lines", "missing", "late"),
    [
        ("", Limit(0.015, "safety.missing_time = 0.015 s"), Limit(0.05, "safety.late_time = 0.05 s")),
        (
            "max_missing = 3\nmax_late = 3",
            Limit(4 / RATE, "safety.max_missing = 3"),
            Limit(3.5 / RATE, "safety.max_late = 3"),
        ),
        (
            "max_missing = 500\nlate_time = 0.1",
            Limit(0.064, "0.8 of safety.watchdog = 0.08 s"),
            Limit(0.064, "0.8 of safety.watchdog = 0.08 s"),
        ),
        (
            "watchdog = 0.1\nmissing_time = 0.08\nmax_late = 31",
            Limit(0.08, "safety.missing_time = 0.08 s"),
            Limit(31.5 / RATE, "safety.max_late = 31"),
        ),
    ],
)
def test_limits_of_silence(arm: Arm, lines: str, missing: Limit, late: Limit) -> None:
    config = arm(safety(lines)) if lines else arm()
    for limit, wanted in ((missing_limit(config), missing), (late_limit(config), late)):
        assert limit.seconds == pytest.approx(wanted.seconds)
        assert limit.said == wanted.said


@pytest.mark.parametrize(
    ("count", "seconds", "too_long"),
    [(1, 1.0, False), (2, 0.015, True), (2, 0.015 - 5e-7, True), (2, 0.015 - 1.5e-6, False), (9, 0.0149, False)],
)
def test_missing_too_long(count: int, seconds: float, too_long: bool) -> None:
    assert is_missing_too_long(count, seconds, Limit(0.015, "")) is too_long


AN_ORDINARY_ONE = {"answered": False, "refused": False, "alone": True}
"""A servo that does not answer although others do."""


def asked(
    silence: Silence, times: Sequence[float], *, refused: bool = False, answered: bool = False, alone: bool = True
) -> list[str | None]:
    """The message about one joint that replies to the first exchange only."""
    silence.ask(0.0)
    silence.heard(0, 0.0)
    said = []
    for now in times:
        silence.ask(now)
        said.append(silence.missed(0, now, answered=answered, refused=refused, alone=alone))
    return said


def test_a_silent_servo_counts_for_the_time_in_which_it_was_asked(arm: Arm) -> None:
    said = asked(Silence(arm(), 1 / RATE), [n / RATE for n in range(1, 7)])
    assert said == [None] * 5 + ["15 ms ago; safety.missing_time = 0.015 s allows 15 ms"]


def test_a_stall_of_the_computer_is_no_silence_of_the_servos(arm: Arm) -> None:
    said = asked(Silence(arm(), 1 / RATE), [0.020 + n / RATE for n in range(6)])
    assert said[:5] == [None] * 5
    assert (
        said[5] == "32 ms ago, 18 ms of it because this computer was busy; safety.missing_time = 0.015 s allows 15 ms"
    )


def test_but_nobody_stays_blind_for_longer_than_deadlines_may_be_missed(arm: Arm) -> None:
    said = asked(Silence(arm(), 1 / RATE), [0.0475, 0.0501])
    assert said[0] is None and said[1] is not None and said[1].startswith("50 ms ago, 45 ms of it because")


def test_waiting_for_a_slow_adapter_is_listening(arm: Arm) -> None:
    assert asked(Silence(arm(), 1 / RATE), [0.0075, 0.015])[-1] is None
    assert asked(Silence(arm(), 1 / RATE, patience=0.0075), [0.0075, 0.015])[-1] is not None


@pytest.mark.parametrize(
    ("late", "alone", "replies"),
    [(0.0, False, 6), (0.0009, False, 6), (0.001, False, round(RATE * FAKE.safety.late_time)), (0.001, True, 6)],
)
def test_while_this_program_is_late_silence_of_all_may_be_the_computers(
    arm: Arm, late: float, alone: bool, replies: int
) -> None:
    silence = Silence(arm(), 1 / RATE)
    silence.woke_up(0.0, late)
    said = asked(silence, [n / RATE for n in range(1, 30)], alone=alone)
    assert said.index(next(filter(None, said))) == replies - 1


def test_a_silence_begins_with_the_latest_exchange_that_all_answered(arm: Arm) -> None:
    silence = Silence(arm(), 1 / RATE)
    silence.ask(0.0)
    silence.heard(0, 0.0)
    silence.all_heard(0.1)
    said = []
    for now in [0.1 + n / RATE for n in range(1, 7)]:
        silence.ask(now)
        said.append(silence.missed(0, now, **AN_ORDINARY_ONE))
    assert said == [None] * 5 + ["15 ms ago; safety.missing_time = 0.015 s allows 15 ms"]


def test_a_computer_is_busy_for_a_while_only(arm: Arm) -> None:
    silence = Silence(arm(), 1 / RATE)
    silence.woke_up(0.0, 0.003)
    silence.ask(1.99)
    assert silence.is_busy
    silence.ask(2.01)
    assert not silence.is_busy


def test_servos_that_were_never_heard_are_silent_from_the_first_exchange_on(arm: Arm) -> None:
    silence, said = Silence(arm(), 1 / RATE, patience=3 / RATE), []
    assert not silence.any_missed and not silence.others_answer and not silence.is_busy
    for number in range(6):
        silence.ask(10.0 + number / RATE)
        said.append(silence.missed(0, 10.0 + number / RATE, **AN_ORDINARY_ONE))
    assert said[:-1] == [None] * 5 and said[-1] is not None and said[-1].startswith("15 ms ago; safety.missing_time")


@pytest.mark.parametrize(
    ("stall", "is_busy", "told"), [(0.02, True, True), (0.02, False, False), (0.0009, True, False)]
)
def test_while_an_arm_is_lowered_a_stall_is_blamed_on_the_computer_only_if_that_is_known_to_be_busy(
    arm: Arm, stall: float, is_busy: bool, told: bool
) -> None:
    silence = Silence(arm(), 1 / RATE, heard_at=0.0)
    if is_busy:
        silence.woke_up(0.0, 0.003)
    silence.ask(0.0)
    silence.heard(0, 0.0)
    said = None
    for number in range(1, 40):
        now = stall + number / RATE
        silence.ask(now)
        if (said := silence.missed(0, now, **AN_ORDINARY_ONE)) is not None:
            break
    assert said is not None and "lowering the arm" in said
    assert ("because this computer was busy" in said) is told


@pytest.mark.parametrize(("stall", "told"), [(0.0009, False), (0.0011, True)])
def test_a_stall_of_a_millisecond_is_told(arm: Arm, stall: float, told: bool) -> None:
    said = asked(Silence(arm(), 1 / RATE), [stall + n / RATE for n in range(1, 7)])[-1]
    assert said is not None and ("1 ms of it because this computer was busy" in said) is told


@pytest.mark.parametrize("lowered", [False, True])
def test_on_the_way_down_one_missing_reply_may_be_the_second(arm: Arm, lowered: bool) -> None:
    """Replies may have been missing before."""
    silence = Silence(arm(), 1 / RATE, heard_at=0.0 if lowered else None)
    if not lowered:
        silence.ask(0.0)
        silence.heard(0, 0.0)
    silence.ask(0.07)
    assert (silence.missed(0, 0.07, **AN_ORDINARY_ONE) is not None) is lowered


def test_the_time_spent_waiting_for_a_reply_counts_as_silence(arm: Arm) -> None:
    """Even if it ends between two exchanges."""
    silence = Silence(arm(), 0.005, patience=0.02, heard_at=0.0)
    silence.ask(0.01)
    assert silence.missed(0, 0.027, **AN_ORDINARY_ONE) is None
    silence = Silence(arm(), 0.005, patience=0.02, heard_at=0.0)
    silence.ask(0.01)
    assert (
        silence.missed(0, 0.029, **AN_ORDINARY_ONE)
        == "29 ms ago; lowering the arm while other servos answer allows 28 ms"
    )


def test_one_refusal_is_enough_after_the_time_allowed(arm: Arm) -> None:
    silence = Silence(arm(), 0.02)
    assert asked(silence, [0.02], refused=True)[-1] is not None
    assert asked(Silence(arm(), 0.02), [0.02])[-1] is None
    busy = Silence(arm(), 0.0025)
    busy.woke_up(0.0, 0.003)
    times = [0.0025 * count for count in range(1, 9)]
    assert asked(busy, times, answered=True, alone=False)[-1] is not None, "a busy computer is no excuse"


@given(
    gaps=st.lists(st.floats(0.0, 0.08), min_size=1, max_size=40),
    interval=st.sampled_from([0.001, 0.0025, 0.01]),
)
def test_a_servo_is_never_silent_for_longer_than_either_limit(gaps: list[float], interval: float) -> None:
    """Regardless of the computer's load, the second missing reply after the limit of missed deadlines is one too
    many.
    """
    times = np.cumsum(gaps).tolist()
    said = asked(Silence(FAKE, interval), times)
    for count, (now, each) in enumerate(zip(times, said, strict=True), start=1):
        if count >= 2 and now >= 0.05:
            assert each is not None
        if each is None and count >= 2:
            assert count * interval < 0.015


@pytest.mark.parametrize(
    ("waited", "heard", "said"),
    [
        (3, "", "while this program waited for replies that were lost or damaged. Check the cables"),
        (3, "Bytes arrived, but damaged.", "lost or damaged. Bytes arrived, but damaged."),
        (2, "Bytes arrived, but damaged.", "the replies arrive too late for 400 Hz. `hil check` measures"),
    ],
)
def test_deadlines_missed_while_waiting_for_lost_replies_are_not_blamed_on_the_adapter(
    arm: Arm, waited: int, heard: str, said: str
) -> None:
    deadlines = Deadlines(arm(), lambda: heard)
    with pytest.raises(SafetyStop) as stop:
        for _ in range(100):
            for number in range(5):
                deadlines.missed(waited=number < waited)
            deadlines.met()
    assert said in str(stop.value)
