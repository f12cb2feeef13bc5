"""`hil report` and `hil export` on the command line: their output, and incomplete or damaged runs."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from hil.cli.views.result_table import print_result
from hil.model_file import read_settled_result
from hil.runs.run_folder import RunFolder
from tests.support.command_line import hil
from tests.support.processes import forked


@pytest.fixture(autouse=True)
def _argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", sys.argv)


def test_report_prints_where_it_is(identified: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("report", identified) == 0
    assert capsys.readouterr().out.strip() == str(identified / "report.html")
    assert hil("report", identified, "--out", tmp_path / "x.html", "--svg", tmp_path / "pictures") == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "x.html").is_file()
    assert f"{len(list((tmp_path / 'pictures').glob('*.svg')))} figures in" in printed


def test_export_prints_files_and_what_they_lack(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("export", identified, "--format", "urdf", "--format", "toml") == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == str(identified / "arm.urdf") and printed[-1] == str(identified / "arm.toml")
    assert any(line.startswith("  URDF cannot represent armature_2 = 0.0") for line in printed)


@pytest.mark.parametrize("command", [("report",), ("export", "--format", "urdf")])
def test_a_run_that_is_not_whole_is_one_message_and_code_2(
    identified: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    path = identified / "result.json"
    newer = json.dumps({**json.loads(path.read_text(encoding="utf-8")), "schema": 7})
    for content, said in ((newer, "a newer"), ('{"schema": 1,', "incomplete or damaged"), (None, "hil estimate")):
        path.unlink() if content is None else path.write_text(content, encoding="utf-8")
        assert hil(*command, identified) == 2
        printed = capsys.readouterr()
        assert said in printed.err and "result.json" in printed.err
        assert printed.out == "" and "Traceback" not in printed.err
    assert hil(*command, tmp_path / "nowhere") == 2


def test_what_can_be_exported_is_although_packages_are_missing(
    identified: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("pyarrow", "mcap", "mcap.writer"):
        monkeypatch.setitem(sys.modules, package, None)
    formats = ("parquet", "csv", "mcap", "json")
    assert hil("export", identified, *(word for name in formats for word in ("--format", name))) == 2
    printed = capsys.readouterr()
    for name in ("csv", "json"):
        assert any(line.endswith(f".{name}") and Path(line).is_file() for line in printed.out.splitlines())
    needed = "Parquet needs the package pyarrow, MCAP needs the package mcap: pip install 'hil[export]'."
    assert printed.err == f"hil: {needed}\n"
    drawn = ("--samples", 2, "--out", tmp_path, "--format", "parquet", "--format", "mjcf")
    assert hil("export", identified, *drawn) == 2
    assert (tmp_path / "arm_0001.xml").is_file()


def test_arguments_that_do_not_go_together(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("export", identified, "--format", "toml", "--format", "json", "--out", "x") == 2
    assert "--out names a single file" in capsys.readouterr().err
    assert hil("export", identified, "--format", "step") == 2
    assert "'step' is not a format" in capsys.readouterr().err
    assert hil("export", identified, "--format", "urdf", "--link-length", 0.2) == 2
    assert "--link-length = 0.2 m is not needed" in capsys.readouterr().err


def test_a_reader_that_closes_early_and_a_full_disk_are_no_traceback(identified: Path) -> None:
    """As `hil runs | head -1` and `hil runs > /dev/full` do."""
    command = ["hil", "diff", str(identified), str(identified)]
    reading, writing = os.pipe()
    os.close(reading)
    real = [sys.executable, "-m", *command]
    closed = subprocess.run(real, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (closed.returncode, closed.stderr) == (0, "")
    with Path("/dev/full").open("w") as full_disk:
        full = forked.run(command, stdout=full_disk, stderr=subprocess.PIPE, text=True)
    assert full.returncode == 1 and "no space left" in full.stderr and "Traceback" not in full.stderr


def test_nowhere_to_write_is_one_message() -> None:
    """As `hil --help > /dev/full` and `hil schema >&-` do."""
    command = f"{shlex.quote(sys.executable)} -m hil"
    for line, said in (("--help > /dev/full", "no space left"), ("schema >&-", "standard output is closed")):
        found = subprocess.run(f"{command} {line}", shell=True, stderr=subprocess.PIPE, text=True, check=False)
        assert found.returncode == 1 and said in found.stderr and found.stderr.count("\n") == 1


def test_no_figure_is_cut_in_a_narrow_terminal(
    identified: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hil("diff", identified, identified) == 0
    wide = capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "40")
    assert hil("diff", identified, identified) == 0
    assert capsys.readouterr().out.split() == wide.split()
    assert hil("runs", identified.parent) == 0
    assert str(identified) in capsys.readouterr().out


def test_errors_are_in_own_standard_errors_and_the_truth_in_the_units_of_the_file(
    identified: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The uncertainty of a torque constant is a unit's: it hides no error of the estimate."""
    result, config = read_settled_result(identified), RunFolder.open(identified).load_config()
    true = (result.truth or {})["gravity_1"]

    def gravity(wrong: float) -> tuple[list[str], str]:
        joints = [
            joint.model_copy(update={"torque_constant": wrong * joint.torque_per_goal, "torque_constant_std": 0.2})
            for joint in config.joints
        ]
        found = replace(result.parameters["gravity_1"], value=1.06 * true, std=0.01 * true)
        changed = replace(result, parameters={**result.parameters, "gravity_1": found})
        print_result(changed, config.model_copy(update={"joints": joints}), identified, Console(width=200))
        out = capsys.readouterr().out
        (line,) = [each for each in out.splitlines() if each.startswith("gravity_1 ")]
        return line.split()[-3:], out

    cells, out = gravity(1.0)
    assert cells[1:] == ["+6.000", "+6.0"] and "The torque constants in the file differ" not in out
    cells, out = gravity(1.06)
    assert float(cells[0]) == pytest.approx(1.06 * true, rel=1e-4)
    assert [abs(float(cell)) for cell in cells[1:]] == [0.0, 0.0]
    assert "The torque constants in the file differ from those of the fake arm's motors" in out
