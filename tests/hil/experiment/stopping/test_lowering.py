"""Stops of a spatial arm: it is lowered if its servos still accept commands; otherwise torque is cut."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.config.schema import load_config
from hil.drivers.bus import ServoBus
from hil.drivers.state import State
from hil.errors import ExperimentError, SafetyStop, StopRequested
from hil.experiment.run import run_experiment
from hil.experiment.stopping.lowering import Lowering
from hil.experiment.stream import Progress
from hil.fakes.protocol_fake import FakeSerial
from hil.plan.chain_plan import make_chain_plan
from hil.runs.recording import Phase, Recorder, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.motion import seen_moving
from tests.support.paths import CONFIGS

NAME = "fake_open_manipulator_x.toml"
RATE = 100
TEXT = replaced(
    (CONFIGS / NAME).read_text(encoding="utf-8"),
    ("period = 10.0", "period = 5.0"),
    ("rate = 400.0", f"rate = {RATE}.0"),
)
AT_S = 3.5
SOON_S = 3.0
"""When faults begin in the campaign's run of the arm, whose path is shorter [s]."""


def play(
    folder: Path, text: str, signals: tuple[float, ...] = (), urdf: str = "open_manipulator_x_like.urdf"
) -> tuple[BaseException, NDArray[np.void]]:
    """Run the arm of this text with Ctrl-C at these times [s]; return what ended it and what was recorded."""
    (folder / urdf).write_bytes((CONFIGS / urdf).read_bytes())
    (folder / NAME).write_text(text, encoding="utf-8")
    config = load_config(folder / NAME)
    run = RunFolder.create(folder / "run", config)
    left = list(signals)

    def watch(progress: Progress) -> None:
        if left and progress.taken >= left[0] * config.experiment.rate:
            left.pop(0)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises((SafetyStop, StopRequested)) as stopped:
        run_experiment(config, run, config.path, watch)
    return stopped.value, load_samples(run.samples_path, len(config.joints))


def with_fault(text: str, fault: str) -> str:
    return text.replace("[fake.chain]\n", f"[[fake.faults]]\n{fault}\n\n[fake.chain]\n", 1)


def rest_of(text: str) -> NDArray[np.float64]:
    line = next(line for line in text.splitlines() if line.startswith("rest_pose"))
    return np.array([float(word) for word in line.split("[")[1].split("]")[0].split(",")])


def test_ctrl_c_lowers_the_arm_to_its_rest_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[tuple[float, ...]]()

    def moved(_: object, bus: ServoBus, before: tuple[float, ...]) -> str:
        asked.append(before)
        assert not any(servo.read("Torque Enable") for servo in bus.drives.values())
        return "Once torque was off, the arm moved."

    monkeypatch.setattr("hil.experiment.run.moved_without_torque", moved)
    error, samples = play(tmp_path, TEXT, (AT_S,))
    assert error.__notes__[-1] == "Once torque was off, the arm moved."
    np.testing.assert_array_equal(asked, samples["position"][-1:])
    lowered = samples[samples["phase"] == Phase.LOWERING]
    assert isinstance(error, StopRequested)
    assert any("lowered to its rest pose" in note for note in error.__notes__)
    np.testing.assert_allclose(samples["position"][-1], rest_of(TEXT), atol=0.05)
    assert np.abs(samples["velocity"][-1]).max() < 0.1
    assert np.abs(lowered["goal_current"][-1]).max() < 0.1  # the arm does not drop when torque is cut
    assert np.abs(lowered["velocity"][round(0.3 * RATE) :]).max() < 1.0  # braked, then slowly
    assert len(lowered) / RATE < 12.0


KOCH = """
[joint_path]
centre = [0.0, -1.1, 1.1, 0.1, 0.0]
swing = [0.8, 0.25, 0.2, 0.25, 1.2]
speed = [2.0, 1.2, 1.2, 1.2, 3.0]

[stabiliser]
stiffness = [2.69, 3.35, 0.723, 0.227, 0.304]
damping = [0.163, 0.177, 0.0315, 0.0093, 0.0127]

[experiment]
"""


@pytest.mark.parametrize("at", [3.0, 4.0, 5.0])
def test_the_brake_does_not_throw_a_light_wrist_at_a_low_rate(tmp_path: Path, at: float) -> None:
    """Its first torque acts for a whole sample: with too heavy a rotor assumed, it reversed the wrist at 7 rad/s."""
    text = (CONFIGS / "koch.toml").read_text(encoding="utf-8")
    text = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("pilot = true"))
    slow = ("rate = 400.0", "rate = 80.0"), ("period = 10.0", "period = 4.0"), ("band = [0.1", "band = [0.25")
    text = replaced(text, ("[experiment]\n", KOCH), *slow)
    error, samples = play(tmp_path, text, (at,), "koch_like.urdf")
    braked = samples[samples["phase"] == Phase.LOWERING]
    assert any("lowered to its rest pose" in note for note in error.__notes__)
    assert np.abs(braked["velocity"]).max() < 2.5


def test_an_arm_off_its_rest_pose_starts_and_ends_where_it_lies(tmp_path: Path) -> None:
    """The spring does not press it against the stop on which it lies, and the estimate uses the same pose."""
    text = TEXT.replace("stops = [-1.79, 1.15]", "stops = [-1.79, 1.05]")
    text = text.replace("start = [0.0, -1.5, 1.0, 1.15]", "start = [0.0, -1.5, 1.0, 1.05]")
    assert text.count("1.05") == 2
    error, samples = play(tmp_path, text, (AT_S,))
    assert isinstance(error, StopRequested)
    assert any("lowered to its rest pose" in note for note in error.__notes__)
    assert np.abs(samples["goal_current"][samples["phase"] == Phase.REST]).max() < 0.05
    assert abs(samples["position"][-1, 3] - 1.05) < 0.03
    assert RunFolder.open(tmp_path / "run").load_config().arm.rest_pose[3] == pytest.approx(1.05, abs=0.01)


def test_an_arm_that_does_not_reach_its_rest_pose_is_said_to_lie_elsewhere() -> None:
    config = load_config(CONFIGS / NAME)
    rest = config.arm.rest_pose
    lowering = Lowering(config, make_chain_plan(config))
    state: Any = SimpleNamespace(position=(*rest[:2], rest[2] - 0.2, rest[3]))
    assert not lowering.lies(state) and lowering.lies_elsewhere(state) == "'joint3' is at 0.800 rad, -0.20 rad from it"


def test_a_false_velocity_does_not_drive_the_arm_on_its_way_down() -> None:
    """Neither the path that starts with it nor the damper: the positions show that the arm stands still."""
    config = load_config(CONFIGS / NAME)
    rest, none = tuple(config.arm.rest_pose), (0.0,) * 4
    still = State(0.0, 0.001, none, none, none, (rest[0] + 0.3, *rest[1:]), (0,) * 4, (False,) * 4)
    goals = []
    for claimed in (0.0, 4.0, -4.0):
        recent = seen_moving(config, still)
        lowering = Lowering(config, make_chain_plan(config))
        state = still._replace(velocity=(claimed, 0.0, 0.0, 0.0))
        lowering.begin(state, list(none), recent)
        goals.append(lowering.goals(0, state))
    assert config.stabiliser is not None
    torque = [goal[0] * config.joints[0].torque_per_goal for goal in goals]
    assert max(torque) - min(torque) < 0.1 * config.stabiliser.damping[0] * 4.0


def test_another_path_keeps_the_soft_gains_that_late_replies_require() -> None:
    config = load_config(CONFIGS / NAME)
    rest, none = tuple(config.arm.rest_pose), (0.0,) * 4
    still = State(0.0, 0.001, none, none, none, (rest[0] + 0.3, *rest[1:]), (0,) * 4, (False,) * 4)
    lowering = Lowering(config, make_chain_plan(config))
    lowering.begin(still, list(none), seen_moving(config, still))
    usual = lowering._damping.copy()
    lowering.slow_down(8)
    soft = lowering._damping.copy()
    lowering.begin_again(still, list(none))
    np.testing.assert_array_equal(lowering._damping, soft)
    assert (soft < usual).any()


def test_torque_towards_the_path_grows_where_a_joint_stays_off_it() -> None:
    """Friction holds a light joint against a soft spring, but never a joint whose position is unknown."""
    config = load_config(CONFIGS / NAME)
    config = config.model_copy(update={"experiment": config.experiment.model_copy(update={"rate": 200.0})})
    rest, none = np.array(config.arm.rest_pose), (0.0,) * 4
    off = State(0.0, 0.001, none, none, none, tuple(rest - [0.0, 0.0, 0.0, 0.1]), (0,) * 4, (False,) * 4)
    lowering = Lowering(config, make_chain_plan(config))
    count = lowering.begin(off, list(none), seen_moving(config, off))
    lowering._feed[:], lowering._position[:], lowering._velocity[:] = 0.0, rest, 0.0
    assert config.stabiliser is not None
    joint, rate = config.joints[3], config.experiment.rate
    spring = 0.1 * config.stabiliser.stiffness[3]

    def torque(index: int, state: State) -> float:
        return lowering.goals(index, state)[3] * joint.torque_per_goal

    assert torque(0, off) == pytest.approx(spring, rel=0.02)
    unseen = off._replace(position=(*rest[:3], float("nan")), missing=(False, False, False, True))
    for index in range(round(0.5 * rate)):
        torque(0, off if index % 2 else unseen)
    assert torque(0, off) == pytest.approx(1.5 * spring, rel=0.02)
    for _ in range(round(60 * rate)):
        last = torque(0, off)
    assert last == pytest.approx(spring + 0.25 * joint.goal_limit * joint.torque_per_goal, rel=0.02)
    for index in range(count):
        last = torque(index, off)
    assert last == pytest.approx(spring, rel=0.1)  # the joint is let down softly before torque is cut


def test_a_second_signal_cuts_torque_on_the_way_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look, seen = Lowering.look, []

    def signalled(self: Lowering, index: int, state: State, gap: float, *, between: bool = False) -> None:
        seen.append(index)
        if index == 100:
            os.kill(os.getpid(), signal.SIGINT)
        look(self, index, state, gap, between=between)

    monkeypatch.setattr(Lowering, "look", signalled)
    error, samples = play(tmp_path, TEXT, (AT_S,))
    lowered = samples[samples["phase"] == Phase.LOWERING]
    assert any("Torque was cut while the arm was being lowered" in note for note in error.__notes__)
    assert len(lowered) == 101 and set(lowered["period"]) == {-1}


def test_a_joint_held_for_a_moment_is_noticed_and_the_arm_lowered(tmp_path: Path) -> None:
    text = with_fault(TEXT, f'kind = "stuck_joint"\nservo = 2\nat = {AT_S}\nduration = 0.2')
    error, samples = play(tmp_path, text)
    assert "joint2" in str(error)
    stopped = samples["deadline"][np.argmax(samples["phase"] == Phase.LOWERING)]
    assert AT_S < stopped < AT_S + 0.2
    np.testing.assert_allclose(samples["position"][-1], rest_of(TEXT), atol=0.05)


def test_a_joint_that_stays_held_ends_the_lowering(tmp_path: Path) -> None:
    error, samples = play(tmp_path, with_fault(TEXT, f'kind = "stuck_joint"\nservo = 2\nat = {AT_S}'))
    assert any("off its lowering path" in note for note in error.__notes__)
    assert (samples["phase"] == Phase.LOWERING).any()


def stalled(monkeypatch: pytest.MonkeyPatch, folder: Path, seconds: float) -> tuple[BaseException, NDArray[np.void]]:
    """Run the arm with a program that is stopped once, as by SIGSTOP."""
    keep, stalls, ports = Recorder.keep, [seconds], []

    def stall(self: Recorder, deadline: float, *more: Any) -> None:
        keep(self, deadline, *more)
        if self.count == AT_S * RATE:
            ports[0].clock._now += stalls.pop()

    opened = FakeSerial.open
    monkeypatch.setattr(FakeSerial, "open", lambda self: (opened(self), ports.append(self))[0])
    monkeypatch.setattr(Recorder, "keep", stall)
    return play(folder, TEXT)


def test_an_arm_dropped_by_its_watchdogs_is_not_said_to_be_lowered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error, samples = stalled(monkeypatch, tmp_path, 1.0)
    assert not (samples["phase"] == Phase.LOWERING).any()
    notes = " ".join(error.__notes__)
    assert "so it fell: the servos' watchdogs had already tripped" in notes and "deadlines in a row" not in notes


def test_an_arm_is_lowered_after_a_stall_that_its_watchdogs_bore(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error, samples = stalled(monkeypatch, tmp_path, 0.06)
    assert "deadlines in a row" in str(error)
    assert any("lowered to its rest pose" in note for note in error.__notes__)
    np.testing.assert_allclose(samples["position"][-1], rest_of(TEXT), atol=0.05)


def test_a_lost_torque_is_cut_at_once(tmp_path: Path) -> None:
    error, samples = play(tmp_path, with_fault(TEXT, f'kind = "overload"\nservo = 2\nat = {AT_S}'))
    assert not (samples["phase"] == Phase.LOWERING).any()
    assert any("so it fell: a servo had lost its torque" in note for note in error.__notes__)


def test_an_arm_that_does_not_lie_where_the_file_says_is_named_before_torque(tmp_path: Path) -> None:
    """Without its hard stop the elbow falls from the rest pose of the file, and comes to rest elsewhere."""
    text = TEXT.replace("stops = [-0.94, 1.0]\n", "")
    assert text != TEXT
    urdf = "open_manipulator_x_like.urdf"
    (tmp_path / urdf).write_bytes((CONFIGS / urdf).read_bytes())
    (tmp_path / NAME).write_text(text, encoding="utf-8")
    config = load_config(tmp_path / NAME)
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError, match=r"'joint3'.*arm\.rest_pose"):
        run_experiment(config, run, config.path, lambda _: None)
    assert not run.samples_path.exists() or not len(load_samples(run.samples_path, len(config.joints)))


def test_cut_as_configured(tmp_path: Path) -> None:
    text = TEXT.replace("[experiment]", '[safety]\nstop = "cut"\n\n[experiment]', 1)
    _, samples = play(tmp_path, text, (AT_S,))
    assert not (samples["phase"] == Phase.LOWERING).any()


@pytest.fixture(scope="module")
def ready() -> Any:
    from benchmarks.fault_campaign.campaign import prepare
    from benchmarks.spatial.chain_faults import PERIOD_S, Setting, make_document

    return prepare(Setting("fake_open_manipulator_x", 100), PERIOD_S, make_document)


def driven(ready: Any, attacks: tuple[Any, ...] = (), faults: tuple[Any, ...] = ()) -> tuple[str, Any, float]:
    """The words, the servos' own record, and the time of the last current [s] of a run with these faults."""
    from benchmarks.fault_campaign.campaign import play as play_attacked
    from benchmarks.fault_campaign.draw import Drawn

    story, _, changed = play_attacked(ready, Drawn(attacks, faults), 1)
    assert not changed
    record = story.record
    return " ".join(story.text.split()), record, float(record["time"][record["driven"].any(axis=1), 0][-1])


def lost(at: float, seconds: float) -> tuple[Any, ...]:
    from hil.fakes.bus.faults import Fault, FaultKind

    return tuple(Fault(kind=FaultKind.LOST_REPLY, servo=each, at=at, duration=seconds) for each in (1, 2, 3, 4))


@pytest.mark.parametrize(("joint", "at"), [(1, 3.61), (2, 5.3)])
def test_a_turned_motor_does_not_brake_but_is_cut(ready: Any, joint: int, at: float) -> None:
    from benchmarks.fault_campaign.attack import Attack, Kind

    ids = [each.id for each in ready.config.joints]
    text, record, last = driven(ready, (Attack(Kind.WEAK, at, 1e9, ids[joint], 1.0, -1.0),))
    assert "lowered, so it fell" in text and "peak_torque" not in text
    assert "turns the wrong way" in text
    # Wherever in a cycle of 10 ms it begins: 56 to 89 ms, and 1.7 to 3.6 rad/s.
    assert last < at + 0.1
    after = record["time"][:, 0] > at
    assert np.abs(np.gradient(record["position"][after & (record["time"][:, 0] < last), joint], 1e-3)).max() < 4.0
    assert np.abs(record["current"][after, joint]).max() < 0.7 * ready.config.joints[joint].goal_limit


def test_an_arm_that_cannot_be_heard_for_a_moment_is_lowered(ready: Any) -> None:
    text, record, _ = driven(ready, faults=lost(SOON_S, 0.035))
    assert "missed" in text and "lowered to its rest pose" in text
    np.testing.assert_allclose(record["position"][-1], ready.config.arm.rest_pose, atol=0.1)


def test_an_arm_that_is_pushed_off_its_path_is_lowered_from_where_it_is(ready: Any) -> None:
    from benchmarks.fault_campaign.attack import Attack, Kind

    text, record, _ = driven(
        ready, (Attack(Kind.PUSHED, SOON_S, SOON_S + 0.15, ready.config.joints[0].id, 1.0, 1.74, "state"),)
    )
    assert "lowered to its rest pose" in text and "wrong way" not in text
    np.testing.assert_allclose(record["position"][-1], ready.config.arm.rest_pose, atol=0.1)


def test_a_servo_that_only_lost_its_watchdog_is_lowered(ready: Any) -> None:
    """Its Bus Watchdog is cleared by another program and set again; it still receives and obeys."""
    from benchmarks.fault_campaign.attack import Attack, Kind

    text, record, _ = driven(ready, (Attack(Kind.WATCHDOG_OFF, SOON_S, SOON_S, 2, 1.0, 0.0, "state"),))
    assert "no longer protected" in text and "lowered to its rest pose" in text
    np.testing.assert_allclose(record["position"][-1], ready.config.arm.rest_pose, atol=0.1)


@pytest.mark.parametrize("number", [0, 2])
def test_after_one_servo_has_fallen_silent_nothing_feeds_the_watchdogs(ready: Any, number: int) -> None:
    """With another ID, a servo goes on driving until its Bus Watchdog acts; any packet on the bus feeds it."""
    from benchmarks.fault_campaign.attack import Attack, Kind

    servo = ready.config.joints[number].id
    text, _, last = driven(ready, (Attack(Kind.NEW_ID, SOON_S, SOON_S, servo, 1.0, 0.0, "state"),))
    assert "does not answer" in text
    assert last < SOON_S + 0.135, "stopped after at most 55 ms, then 80 ms of watchdog"


def test_an_arm_that_cannot_be_heard_any_more_is_cut(ready: Any) -> None:
    text, _, last = driven(ready, faults=lost(SOON_S, 10.0))
    assert "missed 2 replies" in text and "busy" not in text
    assert SOON_S + 0.03 < last < SOON_S + 0.1


def faults_of(kind: str, **options: Any) -> tuple[Any, ...]:
    from hil.fakes.bus.faults import Fault

    return (Fault(kind=kind, at=SOON_S, **options),)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (faults_of("late_reply", amount=0.013), "too late"),
        (faults_of("late_reply", amount=0.006, probability=0.4), ""),
        (faults_of("low_voltage", servo=2), "oltage"),
        (faults_of("status_error", amount=128), "alert"),
        (faults_of("other_master", servo=3, amount=0.03), "Another master"),
    ],
)
def test_an_arm_whose_servos_obey_is_lowered(ready: Any, faults: tuple[Any, ...], said: str) -> None:
    text, record, _ = driven(ready, faults=faults)
    assert said in text and ("lowered to its rest pose" in text or not said)
    np.testing.assert_allclose(record["position"][-1], ready.config.arm.rest_pose, atol=0.1)


def test_a_reading_that_steps_does_not_drop_the_arm(ready: Any) -> None:
    from benchmarks.fault_campaign.attack import Attack, Kind
    from hil.fakes.bus.faults import Fault, FaultKind

    step = Fault(kind=FaultKind.ENCODER_JUMP, servo=2, at=SOON_S + 0.5, duration=0.03, amount=300)
    text, record, _ = driven(ready, (Attack(Kind.SIGINT, SOON_S, 1e9),), (step,))
    assert "lowered to its rest pose" in text
    np.testing.assert_allclose(record["position"][-1], ready.config.arm.rest_pose, atol=0.1)
