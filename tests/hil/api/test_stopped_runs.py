"""What stopped an arm, and the state of its torque, is what the caller gets: no hint takes its place."""

import re
import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from hil.api import experiment
from hil.api.progress import OnProgress, Progress, forgiving
from hil.cli.stopped import stopped_by_signals
from hil.drivers.errors import BusShared, TorqueNotOff
from hil.errors import Cause, ExperimentError, RunFolderError, SafetyStop, StopRequested
from hil.estimation import after_a_stop
from hil.estimator.errors import ConvergenceError, RecordingError
from hil.plan.plan import IDENTIFY
from hil.runs.background import Background
from hil.runs.run_folder import RunFolder
from tests.support.paths import CONFIGS


class _Run:
    """A run folder that has samples."""

    path = Path("run")
    samples_path = path / "samples.npy"

    def discard_if_unused(self) -> bool:
        return False


@pytest.mark.parametrize("start", [experiment.identify, experiment.record])
def test_doubts_are_told_before_anything_moves(
    start: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    for weak in ("current_limit = 0.001", "peak_torque = [0.0005, 0.0005]"):
        text, changed = re.subn(rf"(?m)^{weak.split()[0]} = .*", weak, text, count=1)
        assert changed
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    told: list[Progress] = []

    def move(*_: object) -> str:
        raise ExperimentError(told[0].message)

    monkeypatch.setattr(experiment, "run_experiment", move)
    with pytest.raises(ExperimentError, match=r"Warning: current_limit of joint .* The joint probably would not move"):
        start(tmp_path / "arm.toml", out=tmp_path / "run", on_progress=told.append)
    assert not (tmp_path / "run").exists()


def test_a_hint_that_fails_leaves_the_stop_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> list[str]:
        raise RecordingError("joint 1 ends the period elsewhere")

    monkeypatch.setattr(experiment, "_how_to_go_on", fail)
    stop = SafetyStop("It has lost its torque.", Cause.TORQUE_OFF)
    stop.add_note("Torque is off on both servos, confirmed by reading it back.")
    run, arm = _Run(), Path("arm.toml")
    with pytest.raises(SafetyStop) as caught, experiment._discarding(run, "identify", arm):  # type: ignore[arg-type]
        raise stop
    assert caught.value is stop and caught.value.__notes__ == [
        "Torque is off on both servos, confirmed by reading it back."
    ]


def test_a_recording_that_the_estimator_refuses_cannot_be_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    class Opened:
        samples_path = Path("samples.npy")

        @classmethod
        def open(cls, _path: Path) -> "Opened":
            return cls()

        def load_config(self) -> "Opened":
            return self

        def load_facts(self) -> "Opened":
            return self

        segments = (IDENTIFY,)
        joints = (1, 2)

    def refuse(*_: object) -> None:
        raise RecordingError("joint 1 ends the period elsewhere")

    monkeypatch.setattr(after_a_stop, "RunFolder", Opened)
    monkeypatch.setattr(after_a_stop, "load_samples", lambda *_: None)
    monkeypatch.setattr(after_a_stop, "settled_period", refuse)
    assert not after_a_stop.can_be_estimated(Path("run"))


def test_a_stop_inside_a_progress_callback_is_a_stop(caplog: pytest.LogCaptureFixture) -> None:
    def interrupted(_: Progress) -> None:
        raise StopRequested("Stopped by Ctrl-C.")

    tell = forgiving(interrupted)
    for _ in range(2):
        with pytest.raises(StopRequested):
            tell(Progress("experiment", "THE ARM MOVES AGAIN"))
    assert not caplog.records


def test_exit_in_a_progress_callback_is_logged_and_an_interrupt_reaches_the_main_thread(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted = threading.Event()
    monkeypatch.setattr("_thread.interrupt_main", interrupted.set)

    def ends(how: type[BaseException]) -> OnProgress:
        def listener(_: Progress) -> None:
            raise how

        return forgiving(listener)

    ends(SystemExit)(Progress("experiment"))
    assert "will not be called again" in caplog.text and not interrupted.is_set()
    with pytest.raises(KeyboardInterrupt):
        ends(KeyboardInterrupt)(Progress("experiment"))
    background = Background(ends(KeyboardInterrupt), 4)
    background.put(Progress("experiment"))
    assert background.close(5.0) == [] and interrupted.is_set()


def test_a_disk_that_fills_up_after_the_experiment_leaves_a_command(tmp_path: Path) -> None:
    full = RunFolderError("run/report.html cannot be written: No space left on device.")
    run: Any = SimpleNamespace(discard_if_unused=lambda: False, result_path=tmp_path / "result.json", path=tmp_path)
    run.result_path.touch()
    with pytest.raises(RunFolderError) as ended, experiment._discarding(run, "identify", Path("arm.toml")):
        raise full
    assert ended.value.exit_code == 1
    assert ended.value.__notes__ == ["The result is kept; the report is missing.", f"Next: hil report {tmp_path}"]


def test_a_stop_after_a_complete_recording_names_the_estimate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run folder is not empty: the same command would be refused."""

    def stopped(_: Path) -> None:
        raise KeyboardInterrupt

    (tmp_path / "arm.toml").write_bytes((CONFIGS / "fake_two_link_ideal.toml").read_bytes())
    monkeypatch.setattr(experiment, "run_experiment", lambda *_: "Torque is off.")
    monkeypatch.setattr(RunFolder, "discard_if_unused", lambda _: False)
    monkeypatch.setattr(experiment, "load_run", stopped)
    monkeypatch.setattr(experiment, "after_a_stop", lambda run, *_: [f"Next: hil estimate {run.path}"])
    with pytest.raises(KeyboardInterrupt) as ended:
        experiment.record(tmp_path / "arm.toml", out=tmp_path / "run")
    assert ended.value.__notes__ == [f"Next: hil estimate {tmp_path / 'run'}"]


@pytest.mark.parametrize(
    ("note", "command"),
    [
        ("Torque is off on both servos.", "record"),
        ("The settings of joint 'elbow' could not be restored.", "check"),
        ("Some settings of joint 'elbow' may not have been restored.", "check"),
        ("Joint 'elbow': PWM Limit was changed during this command from 885 to 400.", "check"),
        ("Another program switched torque on at joint 'elbow'.", "check"),
        ("TORQUE IS ON at ID 1.", "check"),
    ],
)
def test_servos_that_are_not_as_before_are_checked_next(
    monkeypatch: pytest.MonkeyPatch, note: str, command: str
) -> None:
    monkeypatch.setattr(experiment, "after_a_stop", lambda *_: ["The recording is kept.", "Next: hil record a.toml"])
    stopped = KeyboardInterrupt()
    stopped.add_note(note)
    run: Any = None
    assert experiment._how_to_go_on(stopped, run, "record", Path("a.toml"))[-1] == f"Next: hil {command} a.toml"


@pytest.mark.parametrize(
    ("is_chain", "command"), [(False, "hil estimate run --all-samples"), (True, "hil check arm.toml")]
)
def test_a_recording_without_a_result_ends_with_a_command(
    monkeypatch: pytest.MonkeyPatch, is_chain: bool, command: str
) -> None:
    """Only planar arms can be estimated from all samples."""
    run = RunFolder(Path("run"))
    monkeypatch.setattr(RunFolder, "load_config", lambda _: SimpleNamespace(is_chain=is_chain))
    monkeypatch.setattr(RunFolder, "load_facts", lambda _: SimpleNamespace(config="arm.toml"))
    monkeypatch.setattr(experiment, "can_be_estimated", lambda _: True)
    said = experiment._how_to_go_on(ConvergenceError("No minimum was found."), run, "identify", Path("arm.toml"))
    assert said[0].startswith("The recording is kept in run.") and said[-1] == f"Next: {command}"


def test_after_a_motion_that_contradicts_the_description_the_joints_are_moved_by_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`hil check` sees neither a direction nor a zero."""
    monkeypatch.setattr(experiment, "after_a_failure", lambda *_: ["The recording is kept.", "Next: hil check a.toml"])
    run: Any = None
    stop = SafetyStop("Joint 'elbow' is not moving.", Cause.UNEXPECTED)
    for doubts, command in ((False, "check a.toml"), (True, "pose a.toml --guide")):
        stop.doubts_description = doubts
        assert experiment._how_to_go_on(stop, run, "identify", Path("a.toml"))[-1] == f"Next: hil {command}"


@pytest.mark.parametrize(
    ("stopped", "notes"), [(BusShared("Another master"), ["Torque is off."]), (TorqueNotOff("TORQUE IS ON"), [])]
)
def test_a_bus_failure_before_the_first_sample_ends_with_a_command(stopped: Exception, notes: list[str]) -> None:
    run: Any = type("Unused", (), {"discard_if_unused": lambda _: True})()
    for note in notes:
        stopped.add_note(note)
    with pytest.raises(type(stopped)), experiment._discarding(run, "record", Path("a.toml")):
        raise stopped
    assert stopped.__notes__ == [*notes, "Next: hil check a.toml"]


def test_a_signal_before_the_first_sample_leaves_the_command_to_be_typed_again() -> None:
    run: Any = type("Unused", (), {"discard_if_unused": lambda _: True})()
    stopped = StopRequested("Stopped by Ctrl-C.")
    stopped.add_note("Torque is off on both servos.")
    with pytest.raises(StopRequested), experiment._discarding(run, "record", Path("a.toml")):
        raise stopped
    assert stopped.__notes__ == ["Torque is off on both servos."]


@pytest.mark.parametrize(
    ("number", "is_obeyed"), [(signal.SIGINT, True), (signal.SIGTERM, True), (signal.SIGHUP, False)]
)
def test_a_stop_request_is_obeyed_though_a_script_has_ignored_it_for_background_jobs(
    number: signal.Signals, is_obeyed: bool
) -> None:
    """With nohup, SIGHUP is ignored on purpose."""
    former = signal.signal(number, signal.SIG_IGN)
    try:
        with pytest.raises(typer.Exit) if is_obeyed else nullcontext(), stopped_by_signals():
            signal.raise_signal(number)
            time.sleep(0.001)
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, former)


def test_a_signal_before_the_first_sample_ends_with_a_check_if_settings_are_in_doubt() -> None:
    run: Any = type("Unused", (), {"discard_if_unused": lambda _: True})()
    stopped = StopRequested("Stopped by Ctrl-C.")
    stopped.add_note("The settings of joint 'elbow' could not be restored. The next hil check restores them.")
    with pytest.raises(StopRequested) as ended, experiment._discarding(run, "record", Path("a.toml")):
        raise stopped
    assert stopped.__notes__[-1] == "Next: hil check a.toml" and ended.value.exit_code == 130
