"""Ctrl-C and SIGTERM at every stage: nothing finished is lost, and the command named as the next one works."""

import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.edits import FEWER_SAMPLES
from tests.support.paths import CONFIGS
from tests.support.stops.interrupted import STAGES, interrupt

OFTEN = {"held-out part": signal.SIGINT, "report": signal.SIGTERM}
"""Stages tried in every run of the tests, and with which signal; each takes a process."""
WORDS = {
    "identify": ["identify", "arm.toml", "--out", "run"],
    "scan": ["scan", "arm.toml"],
    "check": ["check", "arm.toml"],
    "dry-run": ["dry-run", "arm.toml"],
    "export": ["export", "run", "--format", "mjcf"],
}


def _cases() -> list[object]:
    """Every stage with both signals; all but a few are slow."""
    return [
        pytest.param(
            name, number, marks=() if OFTEN.get(name) is number else pytest.mark.slow, id=f"{name}-{number.name}"
        )
        for name in STAGES
        for number in (signal.SIGINT, signal.SIGTERM)
    ]


@pytest.mark.parametrize(("name", "number"), _cases())
def test_a_stop_loses_nothing_that_was_finished(
    name: str,
    number: signal.Signals,
    identified: Path,
    arm_file: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", sys.argv)
    stage = STAGES[name]
    if stage.pilot or stage.command == "dry-run":
        (tmp_path / "arm.toml").write_text((CONFIGS / "first_time.toml").read_text(encoding="utf-8"), encoding="utf-8")
    else:
        arm_file(*FEWER_SAMPLES)
    if stage.command == "export":
        shutil.copytree(identified, tmp_path / "run")
    found = interrupt(name, number, WORDS[stage.command], tmp_path)
    assert found.faults(number) == [], found.said
    if name in ("held-out part", "ramp out", "first stage of the estimation", "choice", "held-out check"):
        assert found.next == ["hil", "estimate", "run"], "what was finished is estimated"
        assert (tmp_path / "run" / "result.json").is_file() and (tmp_path / "run" / "report.html").is_file()
