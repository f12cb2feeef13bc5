"""A program whose terminal is stopped, or whose pipe nobody reads, ends within a bounded time after a signal."""

import os
import pty
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.cli import output
from hil.cli.output import bounded_output

TEXT = "x" * 79 + "\n"


class Reader:
    """The other end of the standard streams, a terminal or pipe that is read slowly or not at all."""

    def __init__(self, opened: Callable[[], tuple[int, int]]) -> None:
        self.reading, self.writing = opened()
        self.said = b""

    def stand_in(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, os.fdopen(os.dup(self.writing), "w", encoding="utf-8"))

    def read(self, pause: float = 0.0, most: int = 4096) -> None:
        while data := os.read(self.reading, most):
            self.said += data
            if b"end" in self.said[-10:]:
                return
            time.sleep(pause)


@pytest.fixture(params=[os.pipe, pty.openpty])
def reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Reader:
    monkeypatch.setattr(output, "PATIENCE_S", 0.3)
    former = signal.signal(signal.SIGTERM, lambda *_: None)
    request.addfinalizer(lambda: signal.signal(signal.SIGTERM, former))
    return Reader(request.param)


def test_output_that_nobody_reads_is_discarded_after_a_signal_only(
    reader: Reader, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader.stand_in(monkeypatch)
    if os.isatty(reader.writing):
        termios.tcflow(reader.writing, termios.TCOOFF)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
    began = time.monotonic()
    with bounded_output():
        for _ in range(2000):
            print(TEXT, end="")
        print("last words", file=sys.stderr)
    assert 0.5 < time.monotonic() - began < 5.0


def test_a_slow_reader_loses_nothing_although_a_signal_has_arrived(
    reader: Reader, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader.stand_in(monkeypatch)
    thread = threading.Thread(target=reader.read, kwargs={"pause": 0.002, "most": 1500}, daemon=True)
    with bounded_output():
        os.kill(os.getpid(), signal.SIGTERM)
        thread.start()
        for _ in range(2000):
            print(TEXT, end="")
        print("end")
    thread.join(10.0)
    assert reader.said.replace(b"\r\n", b"\n") == TEXT.encode() * 2000 + b"end\n"


def test_files_and_captured_streams_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as file:
        monkeypatch.setattr(sys, "stdout", file)
        monkeypatch.setattr(sys, "stderr", fake := SimpleNamespace(flush=lambda: None))
        with bounded_output():
            assert sys.stdout is file and sys.stderr is fake
