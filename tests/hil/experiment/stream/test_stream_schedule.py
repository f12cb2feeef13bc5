"""What the stream does when, to the microsecond, on a scripted bus, with checks that only note what they are given."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.schema import Config
from hil.drivers.state import Slow, State
from hil.errors import Cause, DidNotMove, ExperimentError, NotSettled, SafetyStop
from hil.experiment import stream as module
from hil.experiment.stream import Progress, Stream
from hil.plan.plan import Segment
from hil.runs.recording import Phase
from tests.support.stream.scripted_bus import JOINTS, NOTHING, TAKES_S, Bus, Checks

Make = Callable[..., tuple[Stream, Bus, Checks]]


def play(stream: Stream, rows: list[float], phase: Phase = Phase.PERIODIC) -> State:
    return stream._play(np.tile(np.array(rows)[:, None], (1, JOINTS)), phase)


def test_its_attributes_stay_inside_the_object(make: Make) -> None:
    """CPython keeps up to 29 there; with more, each access goes through a dictionary, which a cold cache lacks."""
    assert len(vars(make()[0])) < 29


def test_goals_are_exchanged_again_between_two_samples(make: Make) -> None:
    stream, bus, guard = make(turns=5)
    play(stream, [0.1, 0.2, 0.3], Phase.REST)
    at = [round(0.05 + 0.01 * number, 6) for number in range(11)]
    goals = [0.1] * 5 + [0.2] * 5 + [0.3]
    kinds = ["between" if number % 5 else "sample" for number in range(11)]
    assert bus.calls == [(kind, when, goal, goal) for kind, when, goal in zip(kinds, at, goals, strict=True)]
    assert guard.of("look") == [(0.0 if number == 0 else 0.01, number % 5 > 0) for number in range(11)]
    assert guard.of("woke up") == [(when, 0.0) for when in at[::5]]
    assert len(guard.of("at rest")) == 11
    model: Any = stream._model
    assert len(model.of("look")) == 11
    samples = stream._recorder.samples
    assert samples["deadline"] == pytest.approx(at[::5])
    assert set(samples["phase"]) == {Phase.REST} and set(samples["period"]) == {-1}


def test_an_exchange_that_might_delay_the_next_sample_is_left_out(make: Make) -> None:
    stream, bus, _ = make(turns=5, takes=[0.012])
    play(stream, [0.1, 0.2])
    assert bus.times("sample") == [0.05, 0.1] and bus.times("between") == [0.062, 0.074, 0.086]
    stream, bus, _ = make(turns=5, takes=[0.025, TAKES_S])
    play(stream, [0.1, 0.2])
    assert bus.times("between") == [0.075, 0.08, 0.09], "the first one is a whole turn late"


def test_one_slow_exchange_is_forgotten_in_time(make: Make) -> None:
    stream, bus, _ = make(turns=5, takes=[TAKES_S, 0.0125, TAKES_S])
    play(stream, [0.1] * 6)
    assert np.diff(bus.times("sample")) == pytest.approx(0.05)
    # After 12 more exchanges, 0.0125 s times 0.98 for each is less than a turn; until then the last one is left out.
    later = [round(0.05 * sample + 0.01 * turn, 6) for sample in (2, 3, 4) for turn in (1, 2, 3)]
    assert bus.times("between") == [0.06, 0.0725, 0.08, *later, 0.26, 0.27, 0.28, 0.29]


@pytest.mark.parametrize("turns", [1, 2, 5])
def test_read_backs_are_made_right_before_the_exchanges_that_follow(make: Make, turns: int) -> None:
    stream, bus, _ = make(turns=turns)
    bus.read_back_at = -math.inf
    play(stream, [0.1, 0.2])
    apart = 0.05 / turns
    dues = [round(0.05 + apart * number, 6) for number in range(1, turns + 1)]
    assert bus.times("read back") == dues
    assert [call[0] for call in bus.calls] == ["sample", *["read back", "between"] * (turns - 1), "read back", "sample"]
    bus.read_back_at = dues[-1] + 0.05 - 1e-6
    play(stream, [0.3])
    assert bus.times("read back") == [*dues, round(dues[-1] + 0.05, 6)], "only where it is due by then"


def test_goals_that_read_backs_find_lost_are_told_to_the_guard(make: Make) -> None:
    stream, bus, guard = make()
    bus.read_back_at = -math.inf
    play(stream, [0.1])
    assert guard.of("lost") == []
    bus.goals_lost = (1, "its Goal Current reads 3 but 5 was written")
    play(stream, [0.2])
    assert guard.of("lost") == [(1, "its Goal Current reads 3 but 5 was written")]


def test_a_changed_watchdog_is_told_to_the_guard(make: Make) -> None:
    stream, bus, guard = make()
    bus.read_back_at = -math.inf
    play(stream, [0.1])
    assert guard.of("watchdog") == []
    bus.watchdog_changed = (1, 0)
    play(stream, [0.2])
    assert guard.of("watchdog") == [(1, 0)]


def test_missed_ticks_are_told_and_the_goal_stays(make: Make) -> None:
    stream, bus, guard = make()
    play(stream, [0.1])
    bus.clock.wait_until(0.05 + 3.5 * 0.05)
    play(stream, [0.2, 0.3, 0.4, 0.5])
    assert bus.calls == [("sample", 0.05, 0.1, 0.1), ("sample", 0.225, 0.4, 0.4), ("sample", 0.25, 0.5, 0.5)]
    assert guard.of("late") == [(0.175,), (0.175,)]
    # Time in which this program slept is counted from the deadline, then from the latest time it was awake.
    assert guard.of("woke up")[:5] == [(0.05, 0.0), (0.225, 0.125), (0.225, 0.0), (0.225, 0.0), (0.25, 0.0)]
    samples = stream._recorder.samples
    assert samples["missing"][:, 0].tolist() == [0, 1, 1, 0, 0]
    assert samples["goal_current"][:, 0].tolist() == [0.1, 0.1, 0.1, 0.4, 0.5]


def test_before_the_first_exchange_a_missed_tick_counts_from_its_deadline(make: Make) -> None:
    stream, bus, guard = make()
    ticks = stream._pace._ticks
    wait = ticks.wait
    ticks.wait = lambda: (bus.clock.wait_until(0.2), wait())[1]  # type: ignore[method-assign, func-returns-value]
    ticks._start = 0.05
    play(stream, [0.1])
    assert guard.of("late") == [(0.15,)] and not bus.calls
    assert not stream._recorder.samples["goal_current"].any()


def test_progress_is_shown_twenty_times_a_second_and_with_slow_values(make: Make) -> None:
    seen: list[Progress] = []
    stream, bus, _ = make(100.0, watch=seen.append)
    play(stream, [0.1] * 12)
    assert [progress.taken for progress in seen] == [5, 10]
    assert {(progress.expected, progress.phase, progress.role) for progress in seen} == {
        (4 + 4 * 8 + 8, Phase.PERIODIC, "identify")
    }
    bus.slow = Slow((12.0,) * JOINTS, (30.0,) * JOINTS, NOTHING)
    play(stream, [0.1])
    assert [progress.taken for progress in seen] == [5, 10, 13]
    seen.clear()
    stream, _, _ = make(20.0, watch=seen.append)
    play(stream, [0.1] * 3)
    assert [progress.taken for progress in seen] == [1, 2, 3], "every sample at slow rates"


@pytest.mark.parametrize(("status", "wants", "asked"), [(None, True, 0), ((None,) * JOINTS, False, 0), ((), True, 1)])
def test_a_status_in_doubt_is_read_again_next(make: Make, status: Any, wants: bool, asked: int) -> None:
    stream, bus, guard = make()
    bus.status, guard.wants_status = status, wants
    play(stream, [0.1])
    assert bus.calls.count(("status",)) == asked


def test_rest_is_checked_only_before_the_start(make: Make) -> None:
    stream, bus, guard = make()
    play(stream, [0.1])
    notes: list[str] = []
    stream._note = notes.append  # type: ignore[method-assign, assignment]
    assert not guard.of("at rest") and not guard.of("noise")
    stream._rest()
    assert len(guard.of("noise")) == 4 and guard.calls[-1] == ("known",) and notes == ["rest", "noisy"]
    assert len(guard.of("at rest")) == 4 and not any(call[2] for call in bus.calls[1:])


@pytest.mark.parametrize("left_by_a_run", [False, True])
def test_an_arm_that_an_earlier_run_left_may_take_longer_to_come_to_rest(make: Make, left_by_a_run: bool) -> None:
    stream, bus, _ = make(end_samples=12)
    stream._left_by_a_run = left_by_a_run
    bus.velocity = (0.0, 0.5)
    with pytest.raises(ExperimentError, match=r"elbow.* reports a velocity of 0\.50 rad/s before the start"):
        stream._rest()
    assert len(bus.calls) == (4 + 12 if left_by_a_run else 4)


@pytest.mark.parametrize(("steps", "message"), [(1, "one of the two readings is wrong"), (2, "The arm is moving")])
def test_a_velocity_is_false_if_the_position_changes_by_one_step_at_most(make: Make, steps: int, message: str) -> None:
    stream, bus, _ = make()
    bus.velocity, bus.wobble = (0.0, 0.5), 0.99 * steps * abs(bus.joints[1].position_unit)
    with pytest.raises(ExperimentError, match=message):
        stream._rest()


@pytest.mark.parametrize(("earlier", "message"), [(2, "one of the two readings is wrong"), (4, "The arm is moving")])
def test_a_noisy_velocity_is_false_unless_it_has_only_just_begun(make: Make, earlier: int, message: str) -> None:
    stream, bus, _ = make()
    bus.velocity, bus.moves_every = (0.0, 0.5), earlier
    with pytest.raises(ExperimentError, match=message):
        stream._rest()


def settle(stream: Stream, differences: list[float], moved: float = 1.0, since: int = 0) -> list[int]:
    """Let the periods differ from the one before by `differences`; return which periods were played.

    moved: how far the elbow moves in the periods from `since` on [rad].
    """
    played: list[int] = []
    repetition = stream._repetition = SimpleNamespace(difference=math.nan, moved=(1.0, 1.0), worst=1)  # type: ignore[assignment]

    def play_period(_: Segment, period: int) -> None:
        played.append(period)
        if period == since:
            repetition.moved = (1.0, moved)  # type: ignore[misc]
        if period:
            repetition.difference = differences[min(period, len(differences)) - 1]  # type: ignore[attr-defined]

    stream._play_period = play_period  # type: ignore[method-assign]
    try:
        stream._play_periods(stream._plan.segments[0])
    except NotSettled as error:
        error.add_note(str(played))
        raise
    return played


@pytest.mark.parametrize(
    ("differences", "last"), [([0.01], 3), ([0.2, 0.009], 4), ([0.2, 0.1, 0.05, 0.01], 6), ([0.2, 0.2, 0.2, 0.05], 4)]
)
def test_the_other_periods_follow_the_first_settled_one(make: Make, differences: list[float], last: int) -> None:
    stream, _, _ = make()
    assert settle(stream, differences) == list(range(last + 1))


def test_what_never_settles_is_refused_with_the_time_that_it_takes(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    stream, _, _ = make(max_settling_periods=5, warm_up_periods=2)
    with pytest.raises(NotSettled, match=r"After 5 periods of 0\.4 s .* Check for backlash") as stop:
        settle(stream, [0.5, 0.1, 0.4, 0.1, 0.2])
    assert stop.value.__notes__ == [str(list(range(6)))]
    stream, _, _ = make(max_settling_periods=5, warm_up_periods=2)
    monkeypatch.setattr(stream, "_correlation", lambda _: 0.95)
    with pytest.raises(NotSettled, match=r"by a factor of 0\.5 each time: the transient .*periods = 8\.") as stop:
        settle(stream, [0.8, 0.5, 0.25, 0.125, 0.0625])  # three more halve it to 0.8 %
    assert "grease" not in str(stop.value)
    stream, _, _ = make(rate=0.5, max_settling_periods=5, warm_up_periods=2)
    monkeypatch.setattr(stream, "_correlation", lambda _: 0.95)
    with pytest.raises(NotSettled, match=r"50\.0%, 20\.0%, 18\.0%, .*set experiment\.warm_up = 530\.") as stop:
        settle(stream, [0.5, 0.2, 0.18, 0.162, 0.1458])  # 26 more periods: (2 + 5 + 26) * 16 s = 528 s
    stream, _, _ = make(max_settling_periods=5)
    monkeypatch.setattr(stream, "_correlation", lambda _: 0.95)
    with pytest.raises(NotSettled, match=r"Joint 'elbow'.* changes most .*friction may hold it") as stop:
        settle(stream, [3.7, 2.3, 2.0, 1.5, 0.95])
    assert "grease" not in str(stop.value)


@pytest.mark.parametrize(("steps", "is_enough"), [(4.1, True), (3.9, False)])
def test_a_joint_that_hardly_moves_in_a_period_is_stuck(make: Make, steps: float, is_enough: bool) -> None:
    stream, bus, _ = make()
    moved = steps * abs(bus.joints[1].position_unit)
    if is_enough:
        assert settle(stream, [0.01], moved) == [0, 1, 2, 3]
        return
    for since in range(4):
        with pytest.raises(DidNotMove, match=r"elbow.* moved by only 0\.00"):
            settle(stream, [0.01], moved, since)


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("torque", "raise experiment.peak_torque"),
        ("pilot", "experiment.band, so that"),
        ("chain", "raise experiment.rate"),
    ],
)
def test_what_moves_a_stuck_joint_is_something_that_the_configuration_takes(make: Make, kind: str, advice: str) -> None:
    stream, bus, _ = make()
    stream._config = SimpleNamespace(is_chain=kind == "chain", experiment=SimpleNamespace(pilot=kind != "torque"))
    with pytest.raises(DidNotMove, match=f"if it is free, .*{advice}"):
        stream._check_motion([0.0] * len(bus.joints))


class Brakes:
    """In place of the brake: a current for as many exchanges as wanted."""

    wanted = 99

    def __init__(self, _config: Config, apart: float, _recent: object) -> None:
        self.apart = apart

    def goals(self, _state: State) -> list[float] | None:
        self.wanted -= 1
        return [0.7] * JOINTS if self.wanted >= 0 else None


@pytest.mark.parametrize(("turns", "wanted", "count"), [(1, 99, 1), (5, 99, 6), (5, 3, 3), (5, 0, 0)])
def test_a_stop_brakes_at_once_and_for_60_ms_at_most(
    make: Make, monkeypatch: pytest.MonkeyPatch, turns: int, wanted: int, count: int
) -> None:
    monkeypatch.setattr(module, "Brake", Brakes)
    monkeypatch.setattr(Brakes, "wanted", wanted)
    stream, bus, guard = make(turns=turns)
    play(stream, [0.1])
    looks = len(guard.of("look"))

    def fail() -> None:
        raise SafetyStop("stopped", Cause.POSITION)

    stream._play_all = fail  # type: ignore[method-assign]
    with pytest.raises(SafetyStop):
        stream.run()
    begun, apart = 0.05 + TAKES_S, 0.05 / turns
    first = [begun] if count else []
    # The ticks of the brake begin an interval after its first exchange.
    assert bus.times("between") == pytest.approx(
        [*first, *(begun + TAKES_S + apart * number for number in range(1, count))]
    )
    # No sooner than the brake, which replaces the goals that led to the stop.
    kinds = [call[0] for call in bus.calls if call[0] in ("between", "watchdogs")]
    assert kinds == ["between", "watchdogs", *["between"] * (count - 1)][: 2 * count]
    assert bus.times("watchdogs") == [0.04] * bool(count)
    samples = stream._recorder.samples[1:]
    assert len(samples) == count and set(samples["phase"]) <= {Phase.BRAKING} and set(samples["period"]) <= {-1}
    assert len(guard.of("look")) == looks


def test_a_second_signal_or_a_stall_ends_the_brake(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Brake", Brakes)
    stream, bus, _ = make(turns=5, takes=[TAKES_S, TAKES_S, 0.03])
    play(stream, [0.1])
    stream._brake()
    assert len(bus.times("between")) == 2, "the next tick was missed"
    stream, bus, _ = make(turns=5)
    play(stream, [0.1])
    stream._stop = SimpleNamespace(insisted=True)  # type: ignore[assignment]
    stream._brake()
    assert not bus.times("between")


def test_without_any_state_there_is_nothing_to_brake(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Brake", Brakes)
    stream, bus, _ = make()
    stream._brake()
    assert not bus.calls


@pytest.mark.parametrize(
    ("error", "is_told"),
    [(SafetyStop("x", Cause.VELOCITY), True), (SafetyStop("x", Cause.ALERT), False), (ExperimentError("x"), False)],
)
def test_a_foreign_goal_seen_just_before_is_told_with_a_stop_that_it_may_have_caused(
    make: Make, monkeypatch: pytest.MonkeyPatch, error: ExperimentError, is_told: bool
) -> None:
    monkeypatch.setattr(module, "Brake", Brakes)
    stream, bus, _ = make()
    bus.commanded_by_another = "a foreign goal"

    def fail() -> None:
        raise error

    stream._play_all = fail  # type: ignore[method-assign]
    with pytest.raises(ExperimentError):
        stream.run()
    assert getattr(error, "__notes__", []) == ["a foreign goal"] * is_told


def test_a_run_plays_each_multisine_and_comes_to_rest(make: Make) -> None:
    segments = tuple(Segment(role, None, np.full((8, JOINTS), goal), 4) for role, goal in (("a", 0.1), ("b", 0.2)))  # type: ignore[arg-type]
    stream, bus, _ = make(segments=segments, warm_up_periods=2, end_samples=16, max_settling_periods=1)
    stream._check_motion = lambda _: None  # type: ignore[method-assign, assignment]
    stream.run()
    samples = stream._recorder.samples
    changes = np.flatnonzero(np.diff(samples["phase"].astype(int), prepend=-1))
    phases = [Phase(phase) for phase in samples["phase"][changes]]
    each = [Phase.PERIODIC, Phase.RAMP_OUT]
    assert phases == [Phase.REST, Phase.RAMP_IN, Phase.WARM_UP, *each, Phase.RAMP_IN, *each, Phase.COMING_TO_REST]
    lengths = np.diff([*changes, len(samples)]).tolist()
    assert lengths == [4, 4, 16, 32, 4, 4, 32, 4, 4]
    periodic = samples["phase"] == Phase.PERIODIC
    assert samples["period"][periodic].tolist() == np.repeat([0, 1, 2, 3] * 2, 8).tolist()
    assert set(samples["period"][~periodic]) == {-1}
    segment = samples["segment"].tolist()
    assert segment == [0] * (4 + 4 + 16 + 32 + 4) + [1] * (len(samples) - 60)
    assert not any(call[2] for call in bus.calls[-4:])
    goal = samples["goal_current"][:, 0]
    for phase, sign in ((Phase.RAMP_IN, 1), (Phase.RAMP_OUT, -1)):
        assert (sign * np.diff(goal[samples["phase"] == phase][:4]) > 0).all()


def test_the_largest_goal_of_each_joint_is_that_of_all_multisines(make: Make) -> None:
    segments = tuple(Segment("a", None, np.tile(each, (8, 1)), 4) for each in ([0.1, 0.5], [0.3, 0.2], [0.0, 0.0]))  # type: ignore[arg-type, list-item]
    stream, _, _ = make(segments=segments)
    assert module._largest_goals(stream._plan) == pytest.approx([0.3, 0.5])


def test_an_arm_that_keeps_moving_without_current_is_waited_for(make: Make) -> None:
    stream, bus, _ = make(end_samples=12)
    notes: list[str] = []
    stream._note = notes.append  # type: ignore[method-assign, assignment]
    bus.velocity = (0.0, 0.5)
    stream._come_to_rest()
    assert len(bus.calls) == 12 and notes[-1] == "still moving at 0.00, 0.50 rad/s after 3 s without current"
    bus.velocity = NOTHING
    stream._come_to_rest()
    assert len(bus.calls) == 16 and notes[-1] == "at rest"


@pytest.mark.parametrize(("is_stabilised", "is_upright"), [(False, False), (True, False), (True, True)])
def test_only_an_upright_arm_is_balanced_in_the_end(
    make: Make, monkeypatch: pytest.MonkeyPatch, is_stabilised: bool, is_upright: bool
) -> None:
    stream, _, _ = make()
    stream._plan = replace(stream._plan, segments=())
    balanced: list[Any] = []
    monkeypatch.setattr(module, "must_balance", lambda _: is_upright)
    stream._rest = stream._come_to_rest = lambda: None  # type: ignore[method-assign]
    stream._balance = balanced.append  # type: ignore[method-assign]
    stream._stabiliser = object() if is_stabilised else None  # type: ignore[assignment]
    stream._play_all()
    assert len(balanced) == (is_stabilised and is_upright)


@pytest.mark.parametrize(("balanced_after", "is_moving", "windows"), [(0, False, 1), (2, False, 3), (2, True, 5)])
def test_balancing_ends_once_the_arm_is_balanced_and_still_or_its_time_is_up(
    make: Make, balanced_after: int, is_moving: bool, windows: int
) -> None:
    stream, bus, guard = make(end_samples=20)
    looks: list[State] = []

    def is_balanced(_: Config, state: State) -> bool:
        looks.append(state)
        return len(looks) > balanced_after

    stabiliser: Any = SimpleNamespace(
        balance=lambda: None, is_balanced=is_balanced, add=lambda goal, _: [each + 0.25 for each in goal]
    )
    stream._stabiliser = stabiliser
    bus.velocity = (0.0, 0.5 * is_moving)
    stream._balance(stabiliser)
    assert len(bus.calls) == 4 * windows and all(call[2] == 0.25 for call in bus.calls)
    assert not guard.of("at rest")


@pytest.mark.parametrize(
    ("can_be_lowered", "may_brake", "does"),
    [(True, True, "lower"), (False, True, "brake"), (True, False, "lower"), (False, False, "")],
)
def test_a_stopped_arm_is_lowered_or_braked_or_neither(
    make: Make, monkeypatch: pytest.MonkeyPatch, can_be_lowered: bool, may_brake: bool, does: str
) -> None:
    stream, _, _ = make()
    monkeypatch.setattr(module, "may_brake", lambda *_: may_brake)
    done: list[str] = []
    way_down: Any = SimpleNamespace(lower=lambda *_: done.append("lower"))
    stream._way_down = way_down if can_be_lowered else None
    stream._brake = lambda: done.append("brake")  # type: ignore[method-assign]

    def fail() -> None:
        raise ExperimentError("stopped")

    stream._play_all = fail  # type: ignore[method-assign]
    with pytest.raises(ExperimentError):
        stream.run()
    assert done == ([does] if does else [])


@pytest.mark.parametrize("turns", [1, 5])
def test_the_guard_is_told_how_far_apart_exchanges_are(make: Make, monkeypatch: pytest.MonkeyPatch, turns: int) -> None:
    given: list[float] = []

    class Timed(Checks):
        def __init__(self, *_: Any, interval: float, **__: Any) -> None:
            super().__init__()
            given.append(interval)

    monkeypatch.setattr(module, "Guard", Timed)
    make(rate=20.0, turns=turns)
    assert given == [pytest.approx(0.05 / turns)]


def test_progress_shows_the_peak_torque_of_each_joint(make: Make) -> None:
    seen: list[Progress] = []
    stream, _, _ = make(20.0, watch=seen.append)
    play(stream, [0.1])
    expected = [0.1 * joint.torque_per_goal for joint in stream._config.joints]
    assert seen[0].peak_torque == pytest.approx(expected)


def test_a_state_with_a_missing_reply_does_not_replace_the_latest_whole_one(make: Make) -> None:
    stream, _, _ = make()
    whole = play(stream, [0.1])
    assert stream._whole is whole
    stream._look(whole._replace(missing=(False, True)), Phase.PERIODIC)
    assert stream._whole is whole


def test_a_stop_by_lost_torque_says_nothing_about_the_motion(make: Make) -> None:
    stream, bus, guard = make()
    bus.torque_lost = 1

    def torque_is_off(_: int) -> None:
        raise SafetyStop("no torque", Cause.NOT_FOLLOWING)

    guard.torque_is_off = torque_is_off  # type: ignore[attr-defined]
    with pytest.raises(SafetyStop, match="no torque Symptom") as stop:
        stream._name_lost_torque(SafetyStop("x", Cause.FROZEN))
    assert stop.value.overruled
