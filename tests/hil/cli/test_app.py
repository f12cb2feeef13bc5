"""The command line as users see it: output, files, exit codes, and one clear message instead of a traceback."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli.errors import exit_code
from hil.errors import RunFolderError
from hil.runs.recording import load_samples
from tests.support.command_line import hil
from tests.support.edits import QUICK, QUICK_WITH_HELD_OUT
from tests.support.paths import CONFIGS
from tests.support.processes import forked

ArmFile = Callable[..., Path]

LONG = (
    ("rate = 400.0", "rate = 200.0"),
    ("period = 2.0", "period = 30.0"),
    ("band = [0.5, 6.0]", "band = [0.1, 0.3]"),
    (
        "peak_torque = [0.80, 0.42]",
        "peak_torque = [0.2, 0.1]",
    ),  # with more torque, such a slow motion would swing over the top
)
"""Changes that make an experiment long enough to be interrupted."""


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setenv("COLUMNS", "120")


def without_timing(result: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in result.items() if key != "timing"}


def test_identify_prints_a_table_and_estimate_gives_the_same_numbers_again(
    arm_file: ArmFile, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hil("identify", arm_file(*QUICK_WITH_HELD_OUT), "--out", "run") == 0
    printed = capsys.readouterr()
    for said in (
        "inertia_1",
        "kg m^2",
        "offset_2",
        "truth",
        "Residual",
        "0.2887",
        "Run folder: run",
        "hil estimate run",
    ):
        assert said in printed.out
    assert "Torque is off on both servos" in printed.err
    first = json.loads(Path("run/result.json").read_text(encoding="utf-8"))
    assert hil("estimate", "run", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert without_timing(again) == without_timing(first)
    assert list(first["parameters"]) == list(first["truth"])
    assert first["schema"] == 1 and first["joints"] == 2


def test_a_recording_alone_is_estimated_later(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("record", arm_file(*QUICK), "--out", "run", "--json") == 0
    recorded = json.loads(capsys.readouterr().out)
    assert recorded["samples"] == len(load_samples(Path("run/samples.npy"), 2)) > 1000
    assert recorded["timing"]["lost_replies"] == 0
    assert not Path("run/result.json").exists()
    assert hil("estimate", "run") == 0
    assert "gravity_1" in capsys.readouterr().out


def test_a_pilot_is_not_recorded_alone(capsys: pytest.CaptureFixture[str]) -> None:
    config = CONFIGS / "first_time.toml"
    assert hil("record", config, "--out", "run") == 2
    assert "set experiment.peak_torque and pilot = false" in capsys.readouterr().err
    assert not Path("run").exists()


def test_json_is_the_only_thing_on_standard_output_and_the_run_folder_is_named_after_time_and_arm(
    arm_file: ArmFile, capsys: pytest.CaptureFixture[str]
) -> None:
    """That a seed gives one result is seen in tests/hil/api/test_front_door.py, which identifies one arm twice."""
    assert hil("identify", arm_file(*QUICK), "--json") == 0
    told = json.loads(capsys.readouterr().out)["timing"]
    assert told["lost_replies"] == 0 and told["rate_held"] == pytest.approx(200.0)
    (folder,) = Path("runs").iterdir()
    assert folder.name.endswith("-arm")
    assert {file.name for file in folder.iterdir()} == {
        "config.toml", "run.json", "events.jsonl", "samples.npy", "lateness.json", "result.json", "period.npz",
        "report.html", "servo_settings.json",
    }  # fmt: skip
    assert (folder / "config.toml").read_bytes() == Path("arm.toml").read_bytes()
    events = [json.loads(line)["event"] for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    assert events[-1].startswith("Torque is off on both servos")


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        (("rate = 400.0", "rate = -1"), 2, "arm.toml: experiment.rate = -1: must be at least 20"),
        (('"fake://" ', '"/dev/no-such-port" '), 2, "Cannot open port '/dev/no-such-port'"),
        (('"fake://" ', '"fake://elsewhere.toml" '), 2, "elsewhere.toml cannot be read"),
        (("id = 2", "id = 7"), 1, "'elbow' (ID 7, XM430-W350) does not answer"),
        (('model = "XM430-W350"', 'model = "XM540-W270"'), 2, "answers at ID 1"),
        (("[-3.1, 3.1]", "[-0.5, 0.5]"), 1, "outside its position limit"),
        (("seed = 1\n", "seed = 1\nsettle_within = 1e-9\nmax_settling_periods = 1\n"), 1, "experiment.settle_within"),
    ],
)
def test_a_failure_is_one_message_and_an_exit_code(
    arm_file: ArmFile, capsys: pytest.CaptureFixture[str], change: tuple[str, str], code: int, said: str
) -> None:
    assert hil("identify", arm_file(change), "--out", "run") == code
    printed = capsys.readouterr()
    assert said in printed.err
    assert "Traceback" not in printed.err
    assert printed.out == ""
    if "outside" in said:
        assert "Torque is off on both servos, confirmed by reading it back." in printed.err
        assert printed.err.splitlines()[-1].startswith("Next: hil check "), "the last line is what to type next"


@pytest.mark.parametrize("is_cause", [False, True])
def test_too_many_open_files_are_no_wrong_input(is_cause: bool) -> None:
    raised, lost = OSError(errno.EMFILE, "Too many open files"), RunFolderError("samples.npy cannot be read.")
    lost.__cause__ = raised if is_cause else OSError(errno.EACCES, "Permission denied")
    assert exit_code(lost) == (1 if is_cause else 2)
    assert exit_code(raised) == 1


def test_without_free_file_descriptors_torque_and_recording_are_still_said(
    arm_file: ArmFile, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> Any:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("hil.runs.recording._cut", fails)
    monkeypatch.setattr(Path, "rglob", fails)
    assert hil("record", arm_file(*QUICK), "--out", tmp_path / "run") == 1
    said = capsys.readouterr().err.splitlines()
    assert re.search(r"npy cannot be truncated to its \d+ samples \(Too many open files\), but holds all", said[0])
    assert said[1] == "Torque is off on both servos, confirmed by reading it back."
    assert said[-1] == f"Next: hil estimate {tmp_path / 'run'}", "the rows are there"


def test_bad_arguments_and_files(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("identify", "nowhere.toml") == 2
    assert "nowhere.toml cannot be read: No such file" in capsys.readouterr().err
    assert hil("identify") == 2
    assert hil("estimate", "nowhere") == 2
    assert "nowhere is not a run folder: it has no config.toml" in capsys.readouterr().err
    Path("file").touch()
    assert hil("identify", arm_file(), "--out", "file/run") == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_recording_cut_short_is_said(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = identified / "samples.npy"
    whole = np.load(path)
    np.save(path, whole[:1200])
    assert hil("estimate", identified) == 1
    assert "holds 600 samples of the multisine for 'identify', 0 whole periods" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[:5000])
    assert hil("estimate", identified) == 2
    assert "samples.npy cannot be read" in capsys.readouterr().err


def test_a_killed_process_leaves_its_samples_on_file(arm_file: ArmFile, tmp_path: Path) -> None:
    path = arm_file(*LONG)
    with forked.start(["hil", "identify", str(path), "--out", "run"]) as process:
        samples = tmp_path / "run" / "samples.npy"
        for _ in range(600):
            time.sleep(0.05)
            if samples.is_file() and samples.stat().st_size and len(load_samples(samples, 2)) > 1000:
                break
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    kept = load_samples(samples, 2)
    assert len(kept) > 1000
    assert (kept["time_after_read"] > kept["time_before_write"]).all()


def test_sigterm_ends_in_a_message_and_exit_code_143(arm_file: ArmFile, tmp_path: Path) -> None:
    path = arm_file(*LONG)
    command = ["hil", "identify", str(path), "--out", "run"]
    with forked.start(command, stderr=subprocess.PIPE, text=True) as process:
        for _ in range(600):
            time.sleep(0.05)
            if (tmp_path / "run" / "events.jsonl").is_file() and "ramp in" in (
                tmp_path / "run" / "events.jsonl"
            ).read_text(encoding="utf-8"):
                break
        process.send_signal(signal.SIGTERM)
        assert process.stderr is not None
        message = process.stderr.read()
        assert process.wait() == 143
    assert "Stopped by SIGTERM." in message
    assert "Torque is off on both servos, confirmed by reading it back." in message
    assert "Traceback" not in message


def test_help_shows_an_example_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("identify", "--help") == 0
    assert "Example: hil identify configs/fake_two_link.toml" in capsys.readouterr().out
    assert hil("--version") == 0
    assert capsys.readouterr().out.startswith("hil 0.")
