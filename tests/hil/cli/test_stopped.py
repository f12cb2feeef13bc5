"""A signal while no arm moves ends the command, but never in the middle of loading a module."""

import errno
import importlib
import signal
import sys
import time
from pathlib import Path

import pytest
import typer

from hil.cli.stopped import Terminated, stopped_by_signals

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


@pytest.mark.parametrize(("number", "ends"), [(errno.EIO, typer.Exit), (errno.ENOSPC, OSError)])
def test_a_terminal_that_is_closed_ends_the_command_as_its_signal_does(number: int, ends: type[Exception]) -> None:
    """Its progress bar can no longer be drawn; an error that has another cause is not hidden."""
    with pytest.raises(ends) as ended, stopped_by_signals():
        try:
            raise Terminated(signal.SIGHUP)
        finally:
            raise OSError(number, "the bar")
    if isinstance(ended.value, typer.Exit):
        assert ended.value.exit_code == 128 + signal.SIGHUP


def test_an_error_of_the_terminal_without_a_signal_is_passed_on() -> None:
    with pytest.raises(OSError, match="the bar"), stopped_by_signals():
        raise OSError(errno.EIO, "the bar")
