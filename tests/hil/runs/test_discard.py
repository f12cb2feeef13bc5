"""An experiment that fails before the first sample leaves no folder; a recording is always kept."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.config.schema import Config
from hil.drivers.torque.switch import TorqueSwitch
from hil.errors import RunFolderError
from hil.estimation.after_a_stop import after_a_failure
from hil.experiment import run
from hil.runs.run_folder import RunFolder
from tests.support.command_line import hil
from tests.support.edits import QUICK


def test_a_failed_start_can_be_tried_again(arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_file()
    text = path.read_text(encoding="utf-8").replace('url = "fake://"', 'url = "/dev/no_such_port"')
    path.write_text(text, encoding="utf-8")
    out = path.parent / "run"
    for _ in range(2):
        assert hil("identify", path, "--out", out) == 2
        assert "not empty" not in capsys.readouterr().err
        assert not out.exists()


@pytest.mark.parametrize(
    ("during", "is_made_again"), [("_check_rate", False), ("_check_rate", True), ("_write_facts", True)]
)
def test_a_folder_that_is_lost_before_the_run_is_noticed_before_torque_is_on(
    arm_file: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    during: str,
    is_made_again: bool,
) -> None:
    path = arm_file(*QUICK)
    out = path.parent / "run"
    asked = getattr(run, during)

    def losing(*args: object) -> object:
        done = asked(*args)
        if out.exists():
            out.rename(path.parent / "elsewhere")
        if is_made_again:
            out.mkdir(exist_ok=True)
        return done

    monkeypatch.setattr(run, during, losing)
    monkeypatch.setattr(TorqueSwitch, "_torque_on", lambda *_: pytest.fail("torque was switched on"))
    assert hil("record", path, "--out", out) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"{out} was removed or renamed" in said and "Torque is off" in said
    assert not out.exists()


def test_a_folder_without_a_recording_that_cannot_be_removed_is_not_said_to_hold_one(
    arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = arm_file(*QUICK)
    out = path.parent / "run"

    def full(*_: object) -> None:
        raise RunFolderError(f"{out}/run.json cannot be written: Read-only file system.")

    monkeypatch.setattr(run, "_write_facts", full)
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)
    assert hil("record", path, "--out", out) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "Nothing was recorded" in said and "kept" not in said and f"Next: hil check {path}" in said


def test_a_run_that_was_set_aside_counts_as_recorded(tmp_path: Path) -> None:
    """A pilot's run was repeated because it was late, and the repetition was stopped before its first sample."""
    late = tmp_path / "pilot-1" / "late-1"
    late.mkdir(parents=True)
    (late / "samples.npy").write_bytes(b"0")
    said = after_a_failure(RunFolder(tmp_path), Path("arm.toml"))
    assert said == [f"The recording up to that point is kept in {tmp_path}.", "Next: hil check arm.toml"]


def test_what_was_recorded_stays(identified: Path) -> None:
    assert not RunFolder(identified).discard_if_unused()
    assert (identified / "samples.npy").is_file()


def test_somebody_elses_file_stays(arm: Callable[..., Config], tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", arm())
    (folder.path / "thesis.pdf").write_bytes(b"x")
    assert not folder.discard_if_unused()
    assert (folder.path / "thesis.pdf").is_file()


def test_ctrl_c_during_the_estimate_keeps_the_recording_and_says_how_to_go_on(
    arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: RunFolder) -> None:
        raise KeyboardInterrupt

    path = arm_file(*QUICK)
    out = path.parent / "run"
    with monkeypatch.context() as patched:
        patched.setattr("hil.api.experiment.estimate_run", interrupted)
        assert hil("identify", path, "--out", out) == 130
    said = capsys.readouterr().err
    assert "Stopped by Ctrl-C" in said and f"hil estimate {out}" in said
    assert hil("estimate", out) == 0
