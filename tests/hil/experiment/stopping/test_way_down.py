"""When the way down exchanges what, on a scripted bus, with a lowering that only notes what it is given."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.drivers.state import State
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.experiment.stop_request import StopRequest
from hil.experiment.stopping import way_down as module
from hil.experiment.stopping.way_down import Stopped, WayDown
from hil.plan.plan import Plan, Segment
from hil.runs.recording import Phase, Recorder
from tests.support.paths import CONFIGS
from tests.support.stream.scripted_bus import JOINTS, TAKES_S, Bus, Checks


class Lowers(Checks):
    """In place of the lowering: a path of three samples, during which it notes what it is given."""

    elsewhere = ""
    lies_already = False
    samples = 3

    every = 1
    needs_another_path = False
    pushed_at = -1
    """Number of the look after which another path is needed; -1 for never."""

    def slow_down(self, every: int) -> None:
        self.every = every
        self.calls.append(("slow", every))

    def others_answer(self) -> None:
        self.calls.append(("others answer",))

    def begin_again(self, _state: State, _goal: list[float]) -> int:
        self.needs_another_path = False
        return 2

    def check_time(self, seconds: float) -> None:
        self.calls.append(("time", round(seconds, 6)))

    def lies(self, _state: State) -> bool:
        return self.lies_already

    def begin(self, _state: State, _goal: list[float], _recent: object, _watch: object, _noise: object) -> int:
        return self.samples

    def goals(self, index: int, _state: State) -> list[float]:
        return [0.5 + 0.1 * index] * JOINTS

    def look(self, index: int, _state: State, gap: float, *, between: bool = False) -> None:  # type: ignore[override]
        self.calls.append(("look", index, round(gap, 6), between))
        if len(self.of("look")) == self.pushed_at:
            self.needs_another_path = True

    def lies_elsewhere(self, state: State) -> str:
        return self.elsewhere if all(map(math.isfinite, state.position)) else "at nan"


class Made:
    """A way down whose stream was stopped right after its first exchange, at 0.05 s."""

    def __init__(self, way: WayDown, bus: Bus) -> None:
        self.way, self.bus = way, bus
        lowering: Any = way._lowering
        self.lowering: Lowers = lowering
        bus.clock.wait_until(0.05)
        state = bus.exchange([0.1] * JOINTS)
        self.stopped = Stopped(state, state, [0.1] * JOINTS, state.time_before_write, 0)
        bus.calls.clear()

    def lower(self, **changes: Any) -> list[str]:
        """Lower the arm; return what the error is told."""
        error = ExperimentError("stopped")
        self.way.lower(error, self.stopped._replace(**changes))
        return getattr(error, "__notes__", [])


Make = Callable[..., Made]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a way down at 20 Hz."""
    monkeypatch.setattr(module, "Lowering", Lowers)
    config = load_config(CONFIGS / "fake_two_link_ideal.toml")
    segment = Segment("identify", None, np.full((8, JOINTS), 0.1), 4)  # type: ignore[arg-type]
    plan = Plan(20.0, (segment,), 4, 8, 9, 4, 3, 0.01, 0.05)
    opened: list[Recorder] = []

    def made(turns: int = 1, takes: list[float] | None = None) -> Made:
        recorder = Recorder(tmp_path / "samples.npy", JOINTS, 500)
        opened.append(recorder)
        bus: Any = Bus(config, turns, [TAKES_S, *(takes or [TAKES_S])])
        guard: Any = Checks()
        return Made(WayDown(bus, plan, config, recorder, StopRequest(), lambda _: None, guard, None), bus)

    yield made
    for recorder in opened:
        recorder.close()


@pytest.mark.parametrize("turns", [1, 2])
def test_an_arm_is_lowered_at_the_usual_rate(make: Make, turns: int) -> None:
    made = make(turns=turns)
    bus, lowering = made.bus, made.lowering
    bus.read_back_at = -math.inf
    assert made.lower() == ["The arm was lowered to its rest pose."]
    first = 0.05 + TAKES_S  # at once: until then the goals that led to the stop drive the arm
    at = [round(first + 0.05 * index, 6) for index in range(3)]
    assert bus.times("sample") == at
    assert bus.times("between") == ([] if turns == 1 else [round(each + 0.025, 6) for each in at[:2]])
    assert [call[2] for call in bus.calls if call[0] == "sample"] == pytest.approx([0.5, 0.6, 0.7])
    between = [(0, 0.025, True), (1, 0.025, True)] if turns == 2 else [None, None]
    apart = 0.05 / turns
    wanted = [(0, 0.001, False), between[0], (1, apart, False), between[1], (2, apart, False)]
    assert lowering.of("look") == [each for each in wanted if each is not None]
    assert bus.times("read back")[-1] == at[-1]
    samples = made.way._recorder.samples
    assert len(samples) == 3 and set(samples["phase"]) == {Phase.LOWERING} and set(samples["period"]) == {-1}
    lowering.elsewhere = "elsewhere"
    assert made.lower(sent_at=None) == ["The arm was lowered, but not to its rest pose: elsewhere."]


@pytest.mark.parametrize("cause", [Cause.WATCHDOG, Cause.LATE])
def test_watchdogs_that_another_program_has_changed_are_set_again_first(make: Make, cause: Cause) -> None:
    made = make()
    made.way.lower(SafetyStop("stopped", cause), made.stopped)
    assert [call[0] for call in made.bus.calls].count("rearmed") == (cause is Cause.WATCHDOG)
    assert (made.bus.calls[0] == ("rearmed",)) == (cause is Cause.WATCHDOG)


def test_ticks_missed_while_it_is_lowered_are_told_and_recorded(make: Make) -> None:
    made = make(takes=[0.13, TAKES_S])
    made.lower()
    assert made.lowering.of("late") == [(0.13,)]
    assert made.bus.times("sample") == [0.051, 0.181]
    samples = made.way._recorder.samples
    assert samples["missing"][:, 0].tolist() == [0, 1, 0]
    assert set(samples["phase"]) == {Phase.LOWERING} and set(samples["period"]) == {-1}


@pytest.mark.parametrize(
    ("is_watched", "since", "is_lowered"), [(True, 0.1, True), (True, 0.11, False), (False, 0.11, True)]
)
def test_an_arm_whose_watchdogs_have_acted_cannot_be_lowered(
    make: Make, is_watched: bool, since: float, is_lowered: bool
) -> None:
    """They act 25 ms after their 80 ms at the latest."""
    made = make()
    made.bus.is_watched = is_watched
    made.bus.clock.wait_until(0.05 + since)
    (told,) = made.lower()
    assert ("was lowered" in told) is is_lowered and ("fell: the servos' watchdogs had" in told) is not is_lowered
    assert len(made.bus.times("sample")) == (3 if is_lowered else 0)


@pytest.mark.parametrize(
    ("asked", "silent", "missing", "hides", "is_lowered"),
    [
        (0.018, 0.02, (False, True), False, True),
        (0.027, 0.035, (False, True), False, True),
        (0.029, 0.035, (False, True), False, False),
        (0.027, 0.037, (False, True), False, False),
        (0.045, 0.05, (True, True), False, True),
        (0.045, 0.05, (True, True), True, False),
        (0.045, 0.07, (True, True), False, False),
    ],
)
def test_an_arm_is_lowered_without_replies_only_from_where_it_was_just_seen(
    make: Make, asked: float, silent: float, missing: tuple[bool, bool], hides: bool, is_lowered: bool
) -> None:
    """One servo alone is bridged for less time than all: it may only hear another ID, and be fed by all packets. So the
    last packet counts, and its replies may be awaited.
    """
    made = make()
    made.bus.first_hides = hides
    state = made.stopped.whole
    assert state is not None
    made.bus.clock.wait_until(state.time_before_write + silent)
    latest = state._replace(missing=missing, time_before_write=state.time_before_write + asked)
    (told,) = made.lower(latest=latest)
    assert ("was lowered" in told) is is_lowered and ("it fell: replies had been missing" in told) is not is_lowered
    assert is_lowered or not made.bus.times("sample")


def test_an_arm_that_lies_or_was_not_seen_is_not_lowered(make: Make) -> None:
    made = make()
    assert made.lower(latest=None, whole=None) == [], "no state"
    made.lowering.lies_already = True
    assert made.lower() == []
    made.lowering.lies_already = False
    assert made.stopped.latest is not None
    (told,) = made.lower(latest=made.stopped.latest._replace(error=(4, 0)))
    assert "it fell: a servo answered with an error" in told and not made.bus.calls
    assert made.lower(sent_at=None) == ["The arm was lowered to its rest pose."]


@pytest.mark.parametrize(
    ("stop", "cause", "why"),
    [
        ("cut", Cause.TEMPERATURE, 'it fell: safety.stop = "cut"'),
        ("damp", Cause.WRONG_SIGN, "it fell: its servos could not be relied on"),
    ],
)
def test_an_arm_that_must_not_be_lowered_is_said_to_have_fallen(make: Make, stop: str, cause: Cause, why: str) -> None:
    made = make()
    config = made.way._config
    made.way._config = config.model_copy(update={"safety": config.safety.model_copy(update={"stop": stop})})
    error = SafetyStop("stopped", cause)
    made.way.lower(error, made.stopped)
    (told,) = error.__notes__
    assert why in told and not made.bus.calls


@pytest.mark.parametrize(("count", "asked"), [(0, 1), (1, 1), (2, 2)])
def test_the_signals_so_far_do_not_end_the_lowering(make: Make, count: int, asked: int) -> None:
    made = make()
    told: list[int] = []
    made.way._stop = SimpleNamespace(count=count, check_again=told.append)  # type: ignore[assignment]
    made.lower()
    assert told == [asked] * 3


def test_late_replies_slow_the_way_down(make: Make) -> None:
    """From the second late exchange on, every second sample is exchanged: the servos hold their goals meanwhile."""
    made = make(takes=[0.06])
    made.lowering.samples = 12
    assert made.lower() == ["The arm was lowered to its rest pose."]
    assert made.bus.times("sample") == pytest.approx([0.051, 0.111, 0.201, 0.301, 0.401, 0.501, 0.601])
    assert made.lowering.every == 2 and made.lowering.of("slow") == [(2,)]
    assert [each[0] for each in made.lowering.of("look")] == [0, 1, 3, 5, 7, 9, 11]
    made = make(takes=[0.06, TAKES_S])
    made.lower()
    assert made.lowering.every == 1, "one late exchange may be due to a busy computer"


@pytest.mark.parametrize("keeps_torque", [True, False])
def test_an_alert_drops_the_arm_only_with_lost_torque(make: Make, keeps_torque: bool) -> None:
    made = make()
    made.bus.keeps_torque = keeps_torque
    alert = SafetyStop("stopped", Cause.ALERT)
    made.way.lower(alert, made.stopped)
    (told,) = alert.__notes__
    assert ("it fell: a servo had lost its torque" in told) is not keeps_torque
    assert len(made.bus.times("sample")) == (3 if keeps_torque else 0)
    made = make()
    made.bus.keeps_torque, made.bus.error = keeps_torque, (0, 128)
    (told,) = made.lower()
    assert ("was lowered" in told) is keeps_torque and ("lost its torque" in told) is not keeps_torque
    assert len(made.bus.times("sample")) == (3 if keeps_torque else 1) and made.bus.calls.count(("torque",)) == 1


def test_missing_replies_are_asked_for_again_at_once(make: Make) -> None:
    """While there is time before the next sample, and not again once they have come."""
    made = make(takes=[TAKES_S, 0.005, 0.005, TAKES_S])
    made.bus.patience = 0.005
    made.bus.unanswered = [2, 3]
    made.lower()
    first = 0.05 + TAKES_S
    assert made.bus.times("sample") == pytest.approx([first, first + 0.05, first + 0.1])
    assert made.bus.times("between") == pytest.approx([first + 0.055, first + 0.06])
    made = make(takes=[TAKES_S, 0.045, 0.045, TAKES_S])
    made.bus.patience, made.bus.unanswered = 0.045, [2, 3]
    made.lower()
    assert made.bus.times("between") == [], "they would delay the next sample"


def test_a_reply_that_is_missing_at_the_end_leaves_the_last_known_pose(make: Make) -> None:
    made = make()
    made.bus.unanswered = [3]
    assert made.lower() == ["The arm was lowered to its rest pose."]


@pytest.mark.parametrize(
    ("strangers", "late", "awaited"), [(1.0, True, 0.003), (0.0, True, 0.022), (0.0, False, 0.009)]
)
def test_replies_that_another_master_destroys_are_not_awaited_longer(
    make: Make, strangers: float, late: bool, awaited: float
) -> None:
    """Its own replies look like late ones."""
    made = make()
    made.bus.patience = 0.003
    # Late replies are expected for 0.1 s: the last exchange begins at 0.151 s.
    made.bus.heard.strangers, made.bus.heard.late_at = strangers, 0.052 if late else 0.05
    made.lower()
    assert made.bus.patience == pytest.approx(awaited)


def test_the_path_of_an_arm_that_was_not_heard_begins_where_it_was_last_seen(make: Make) -> None:
    made = make()
    state = made.stopped.whole
    assert state is not None
    first = state.time_before_write + 0.05
    made.bus.clock.wait_until(first)
    (told,) = made.lower(latest=state._replace(missing=(True, True), time_before_write=first - 0.004))
    assert "was lowered" in told and [each[0] for each in made.lowering.of("look")] == [1, 2]
    assert made.bus.times("sample") == pytest.approx([first, first + 0.05])


@pytest.mark.parametrize(
    ("silent", "hides", "asked"), [([2, 3], True, 1), ([1], True, 1), ([2], False, 0), ([], True, 0)]
)
def test_silence_of_all_is_looked_into_once(make: Make, silent: list[int], hides: bool, asked: int) -> None:
    made = make(takes=[TAKES_S, 0.045, 0.045, TAKES_S])
    made.bus.patience = 0.045
    made.bus.silent, made.bus.first_hides = silent, hides
    made.lower()
    assert len(made.lowering.of("others answer")) == asked


def test_exchanges_between_samples_that_would_delay_the_next_one_are_left_out(make: Make) -> None:
    made = make(turns=2, takes=[0.03, TAKES_S])
    made.lower()
    first = 0.05 + TAKES_S
    assert made.bus.times("between") == [], "the longest exchange so far took longer than is left"
    assert made.bus.times("sample") == pytest.approx([first, first + 0.05, first + 0.1])
    assert ("torque",) not in made.bus.calls, "no servo has raised an alert"


def test_late_replies_leave_no_time_for_exchanges_between_samples(make: Make) -> None:
    made = make(turns=2, takes=[0.06])
    made.lowering.samples = 12
    made.lower()
    assert made.lowering.every == 2 and made.bus.times("between") == []


def test_an_arm_that_was_pushed_off_its_path_is_lowered_along_another_one(make: Make) -> None:
    made = make()
    made.lowering.pushed_at = 2
    assert made.lower() == ["The arm was lowered to its rest pose."]
    first = 0.05 + TAKES_S
    again = first + 0.05 + TAKES_S
    assert [each[0] for each in made.lowering.of("look")] == [0, 1, 0, 1]
    assert made.bus.times("sample") == pytest.approx([first, first + 0.05, again, again + 0.05])
    assert made.lowering.of("time") == [(pytest.approx(again - first + 2 * 0.05),)]


def test_packets_of_another_master_do_not_end_the_lowering(make: Make) -> None:
    made = make()
    made.lower()
    assert made.bus.calls[:2] == [("others",), ("any order",)]
