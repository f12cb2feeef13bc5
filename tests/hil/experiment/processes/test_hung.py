"""A real process on a pty whose terminal, disk or reader hangs: a signal still cuts torque, and a logged line says so.

The emulated servos themselves record when they lose torque. Whether that takes long is counted in the commands that
they receive after the signal, not in seconds, because the computer may be busy; the slow tests measure seconds.
"""

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from hil.fakes.description import load_fake
from hil.fakes.pty_server import PtyServer
from tests.support.edits import replaced
from tests.support.paths import CONFIGS, ROOT
from tests.support.processes import forked

CONFIG = CONFIGS / "fake_two_link.toml"
RATE = 50
EXCHANGES_A_SECOND = 100
BOUND_S = 0.1
MOST_COMMANDS = BOUND_S * EXCHANGES_A_SECOND
GIVE_UP_S = 60.0
ATTEMPTS = 3
"""On a busy computer an experiment may end by itself before anything hangs."""

WATCHDOG_S = 1.0
GOALS, TORQUE_OFF = b"\x83\x66\x00\x02\x00", b"\x83\x40\x00\x01\x00"
"""Starts of Sync Writes: instruction, address and size of Goal Current and Torque Enable."""


@dataclass
class Servos:
    """The served servos, and (time [s], what) of each command they received: goals, torque off."""

    server: PtyServer
    commands: list[tuple[float, str]] = field(default_factory=list)

    def listen(self) -> None:
        bus = self.server.bus
        write = bus.write

        def written(data: bytes) -> None:
            for start, what in ((GOALS, "goals"), (TORQUE_OFF, "off")):
                if start in data:
                    self.commands.append((time.monotonic(), what))
            write(data)

        bus.write = written  # type: ignore[method-assign]

    @property
    def torque(self) -> list[bool]:
        with self.server.lock:
            return [servo.torque_enabled for servo in self.server.bus.servos.values()]


@contextmanager
def served(link: Path) -> Iterator[Servos]:
    server = PtyServer(load_fake(CONFIG), link)
    servos = Servos(server)
    servos.listen()
    thread = Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        yield servos
    finally:
        server.stop()
        thread.join(10.0)
        server.close()


def write_config(folder: Path) -> Path:
    """An experiment of about ten seconds that a busy computer does not stop."""
    text = replaced(
        CONFIG.read_text(encoding="utf-8"),
        ('url = "fake://" ', f'url = "{folder / "arm"}" '),
        ("rate = 400.0 ", f"rate = {RATE}.0 "),
        ("period = 10.0 ", "period = 4.0 "),
        ("band = [0.1, 5.0]", "band = [0.25, 4.0]"),
        ("ramp = 1.0 ", "held_out = false\nrest = 0.2\nramp = 0.2 "),
        (
            "[experiment]",
            f"[safety]\nwatchdog = {WATCHDOG_S}\nlate_time = 0.7\nmissing_time = 0.7\n\n[experiment]",
        ),
    )
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def events(run: Path) -> list[str]:
    """What the files of events say; files that are a pipe are left alone."""
    told = []
    for path in (run / "events.jsonl", run / "events-late.jsonl"):
        if path.is_file():
            told += [json.loads(line)["event"] for line in path.read_text(encoding="utf-8").splitlines()]
    return told


def until(done: Callable[[], bool]) -> bool:
    give_up = time.monotonic() + GIVE_UP_S
    while not done():
        if time.monotonic() > give_up:
            return False
        time.sleep(0.005)
    return True


class Terminal:
    """A terminal for the program's output that can be stopped as by Ctrl-S."""

    def __init__(self, _run: Path) -> None:
        self._master, self.output = pty.openpty()
        os.set_blocking(self._master, False)
        self.said = b""

    def hang(self) -> None:
        self.go_on()
        termios.tcflow(self.output, termios.TCOOFF)

    def release(self) -> None:
        termios.tcflow(self.output, termios.TCOON)

    def go_on(self) -> None:
        """Read what the program has written."""
        with suppress(OSError):
            while data := os.read(self._master, 4096):
                self.said += data

    def close(self) -> None:
        self.go_on()
        os.close(self.output)
        os.close(self._master)


class UnreadPipe:
    """A full pipe that nobody reads."""

    def __init__(self, _run: Path) -> None:
        self._read, self.output = os.pipe()
        fcntl.fcntl(self.output, fcntl.F_SETPIPE_SZ, 4096)
        os.set_blocking(self._read, False)
        self.said = b""

    def hang(self) -> None:
        os.set_blocking(self.output, False)  # it applies to the program's open pipe too, so it is reset at once
        with suppress(BlockingIOError):
            while True:
                os.write(self.output, b"." * 64)
        os.set_blocking(self.output, True)

    def release(self) -> None:
        self.go_on()

    def go_on(self) -> None:
        with suppress(OSError):
            while data := os.read(self._read, 4096):
                self.said += data

    def close(self) -> None:
        self.go_on()
        os.close(self.output)
        os.close(self._read)


class BlockedDisk(UnreadPipe):
    """events.jsonl becomes a pipe without a reader: opening it blocks. The output is an ordinary one."""

    def __init__(self, run: Path) -> None:
        super().__init__(run)
        self._path = run / "events.jsonl"

    def hang(self) -> None:
        self._path.rename(self._path.with_name("events-before.jsonl"))
        os.mkfifo(self._path)


class Nothing(UnreadPipe):
    """Nothing hangs."""

    def hang(self) -> None:
        self.go_on()


Hung = type[Terminal] | type[UnreadPipe]


@dataclass(frozen=True)
class Ending:
    """After the signal: goals received until torque off, seconds until then; events, output and exit code."""

    goals: int
    seconds: float
    events: list[str]
    said: str
    code: int


def end_by(folder: Path, what: Hung, act: Callable[[int], None], *, releases: bool = True) -> Ending:
    """Record on a served arm, let the output or disk hang in the first period, act on the process, and see it end.

    releases: whether the output no longer hangs once torque is off; if not, the process must end all the same.
    """
    for attempt in range(ATTEMPTS):
        place = folder / str(attempt)
        place.mkdir()
        ending = _try(place, what, act, releases)
        if ending is not None:
            return ending
    pytest.fail("the experiment ended by itself, or never started")


def _try(folder: Path, what: Hung, act: Callable[[int], None], releases: bool) -> Ending | None:
    run = folder / "run"
    with served(folder / "arm") as servos:
        output = what(run)
        command = ["hil", "record", str(write_config(folder)), "--out", str(run)]
        streams: Any = {"stdin": subprocess.DEVNULL, "stdout": output.output, "stderr": output.output}
        process: Any = (
            subprocess.Popen([sys.executable, "-m", *command], **streams, cwd=ROOT)
            if what is Terminal
            else forked.start(command, **streams, cwd=ROOT)
        )
        try:
            moving = until(lambda: process.poll() is not None or any("ramp in" in each for each in events(run)))
            time.sleep(0.5)
            if not moving or process.poll() is not None or not all(servos.torque):
                return None
            output.hang()
            time.sleep(0.3)  # until a thread is blocked
            if process.poll() is not None:
                return None
            signalled = time.monotonic()
            act(process.pid)
            assert until(lambda: not any(servos.torque)), "the servos never lost their torque"
            off = min(when for when, what in servos.commands if what == "off" and when > signalled)
            goals = sum(what == "goals" and signalled < when < off for when, what in servos.commands)
            assert until(lambda: any("Torque is off" in each for each in events(run))), "no logged line about torque"
            if releases:
                output.release()
            assert until(lambda: (not releases or output.go_on() is None) and process.poll() is not None), (
                "the program never ends"
            )
            output.release()
            output.go_on()
            return Ending(goals, off - signalled, events(run), output.said.decode(), process.returncode)
        finally:
            process.kill()
            process.wait()
            output.close()


def by(number: signal.Signals) -> Callable[[int], None]:
    return lambda process: os.kill(process, number)


def stopped_for_a_while(process: int) -> None:
    os.kill(process, signal.SIGSTOP)
    time.sleep(1.5 * WATCHDOG_S)
    os.kill(process, signal.SIGCONT)


CASES = [
    (Terminal, signal.SIGINT),
    (BlockedDisk, signal.SIGTERM),
    pytest.param(UnreadPipe, signal.SIGHUP, marks=pytest.mark.slow),  # the program waits as for a terminal
]
OTHERS = [
    (what, number)
    for what in (Terminal, BlockedDisk, UnreadPipe)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
]


@pytest.mark.parametrize(("what", "number"), CASES)
def test_a_signal_cuts_torque_although_something_hangs(tmp_path: Path, what: Hung, number: signal.Signals) -> None:
    ending = end_by(tmp_path, what, by(number))
    assert ending.goals <= MOST_COMMANDS
    assert any("Torque is off on both servos, confirmed by reading it back." in each for each in ending.events)
    name = "Ctrl-C" if number == signal.SIGINT else number.name
    assert f"Stopped by {name}." in ending.said and ending.code == 128 + number


def test_a_program_that_was_stopped_does_not_blame_the_arm(tmp_path: Path) -> None:
    ending = end_by(tmp_path, Nothing, stopped_for_a_while)
    said = " ".join(ending.said.split())
    assert "This program was stopped (Ctrl-Z, SIGSTOP, a debugger)" in said and ending.code == 1
    for blamed in ("encoder", "magnet", "supply", "cable"):
        assert blamed not in said


@pytest.mark.slow
@pytest.mark.parametrize(("what", "number"), OTHERS)
def test_torque_is_off_within_a_tenth_of_a_second(tmp_path: Path, what: Hung, number: signal.Signals) -> None:
    ending = end_by(tmp_path, what, by(number), releases=False)
    assert ending.code == 128 + number
    print(f"{what.__name__} {number.name}: {1e3 * ending.seconds:.0f} ms, {ending.goals} goals")
    assert ending.seconds <= BOUND_S
