"""A program whose terminal is stopped, or whose pipe nobody reads, ends within a bounded time after a signal."""

import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.cli import output
from hil.cli.output import bounded_output
from hil.runs.recording import load_samples
from tests.support.edits import QUICK
from tests.support.paths import ROOT

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
    with pytest.raises(SystemExit) as ended, bounded_output():
        for _ in range(2000):
            print(TEXT, end="")
        print("last words", file=sys.stderr)
    assert ended.value.code == 128 + signal.SIGTERM
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


@pytest.fixture
def full_pipe() -> Iterator[tuple[int, int]]:
    """A full pipe: its reading end, which is open but idle, and its writing end."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writing, b"x" * 512)
    os.set_blocking(writing, True)
    yield reading, writing
    for end in (reading, writing):
        with suppress(OSError):
            os.close(end)


def recorded(arm: Path, out: Path, pipe: int, ignored: str = "") -> subprocess.Popen[bytes]:
    """A process that records a run with this pipe as its standard streams and has reached its final messages.

    ignored: names of signals that are ignored from the start, as in a shell's background jobs.
    """
    words = [sys.executable, "-m", "hil", "record", str(arm), "--out", str(out)]
    shell = ["sh", "-c", f"trap '' {ignored}; exec \"$@\"", "sh"] if ignored else []
    process = subprocess.Popen([*shell, *words], stdout=pipe, stderr=pipe, env=os.environ | {"PYTHONPATH": str(ROOT)})
    events = out / "events.jsonl"
    while not (events.is_file() and '"stopped: ' in events.read_text(encoding="utf-8")):
        assert process.poll() is None
        time.sleep(0.05)
    return process


JUMPS = ("[fake]\n", '[[fake.faults]]\nkind = "encoder_jump"\nservo = 2\nat = 3.0\namount = 500\n\n[fake]\n')


@pytest.mark.parametrize(("number", "ignored"), [(signal.SIGINT, "INT"), (signal.SIGINT, ""), (signal.SIGTERM, "")])
def test_a_stopped_run_whose_last_words_nobody_reads_ends_at_a_signal(
    arm_file: Callable[..., Path], tmp_path: Path, full_pipe: tuple[int, int], number: signal.Signals, ignored: str
) -> None:
    process = recorded(arm_file(*QUICK, JUMPS), tmp_path / "run", full_pipe[1], ignored)
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)  # without a signal, it waits for its reader
        process.send_signal(number)
        assert process.wait(60.0) == 128 + number
    finally:
        process.kill()
        process.wait()
    assert len(load_samples(tmp_path / "run" / "samples.npy", 2)) > 100
    assert "Torque is off on both servos" in (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")


def test_a_reader_that_begins_late_gets_all_last_words(
    arm_file: Callable[..., Path], tmp_path: Path, full_pipe: tuple[int, int]
) -> None:
    process = recorded(arm_file(*QUICK, JUMPS), tmp_path / "run", full_pipe[1])
    os.close(full_pipe[1])
    said = b""
    while piece := os.read(full_pipe[0], 4096):
        said += piece
        time.sleep(0.01)
    assert process.wait(60.0) == 1
    assert said.lstrip(b"x").startswith(b"hil: Joint") and b"\nNext: hil check" in said
