"""The command that a dry run names starts the run that it has simulated."""

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.command_line import hil


@pytest.mark.parametrize(
    ("pilot", "given", "named"), [(True, True, " --from earlier"), (True, False, ""), (False, True, "")]
)
def test_the_next_command_starts_from_the_same_result(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pilot: bool, given: bool, named: str
) -> None:
    config = SimpleNamespace(experiment=SimpleNamespace(pilot=pilot), is_chain=False)
    safe: Any = SimpleNamespace(config=config, found=None, is_safe=True)
    # Not by their dotted names: hil.dry_run is also a function.
    monkeypatch.setattr(import_module("hil.api.dry_run"), "dry_run", lambda *_, **__: safe)
    monkeypatch.setattr(import_module("hil.dry_run.summary"), "print_dry_run", lambda *_: None)
    assert hil("dry-run", Path("fake_two_link"), *(("--result", "earlier") if given else ())) == 0
    assert f"Next: hil identify fake_two_link{named}\n" in capsys.readouterr().out
