"""A signal while no arm moves ends the command, but never in the middle of loading a module."""

import importlib
import signal
import sys
import time
from pathlib import Path

import pytest
import typer

from hil.cli.stopped import stopped_by_signals

SIGNALS_ITSELF = """
import signal
signal.raise_signal(signal.{name})
loaded = True
"""


@pytest.mark.parametrize(("name", "said"), [("SIGINT", "Ctrl-C"), ("SIGTERM", "SIGTERM")])
def test_a_signal_while_a_module_is_loaded_waits_until_it_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, said: str
) -> None:
    """Compiled modules ignore exceptions in their callbacks: such a Ctrl-C would be lost, and the arm would move."""
    module = f"signals_itself_{name}".lower()
    (tmp_path / f"{module}.py").write_text(SIGNALS_ITSELF.format(name=name), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(signal, "getsignal", lambda _: signal.SIG_DFL)  # even if a shell ignores Ctrl-C for its jobs
    with pytest.raises(typer.Exit) as ended, stopped_by_signals():
        importlib.import_module(module)
        time.sleep(5.0)
    assert ended.value.exit_code == 128 + signal.Signals[name] and sys.modules[module].loaded
    assert f"hil: Stopped by {said}." in capsys.readouterr().err
