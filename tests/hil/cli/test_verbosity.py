"""-v and -q on every subcommand."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.cli.app import COMMANDS
from tests.support.command_line import hil
from tests.support.edits import QUICK


@pytest.fixture(autouse=True)
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["hil"])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_subcommand_has_an_example_and_both_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil(name, "--help") == 0
    said = capsys.readouterr().out
    assert f"Example: hil {name}" in said and "-v, --verbose" in said and "-q, --quiet" in said


def test_more_and_less_is_said_on_standard_error(
    arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = arm_file(*QUICK)
    assert hil("record", path, "--out", "plain") == 0
    plain = capsys.readouterr()
    assert "Torque is off" in plain.err and "INFO" not in plain.err
    assert hil("record", path, "--out", "more", "-v") == 0
    more = capsys.readouterr()
    assert "INFO hil.runs.run_folder" in more.err and "torque on, watchdog" in more.err
    assert hil("record", path, "--out", "less", "-q") == 0
    less = capsys.readouterr()
    assert less.err == "" and "Run folder: less" in less.out
    assert hil("estimate", "nowhere", "-q") == 2
    assert "nowhere is not a run folder" in capsys.readouterr().err
    assert hil("schema", "-v", "-q") == 2
    assert "not both" in capsys.readouterr().err
    assert hil("schema") == 0
    assert logging.getLogger("hil").level == logging.NOTSET, "one command's choice does not outlive it"
