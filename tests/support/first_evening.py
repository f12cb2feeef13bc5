"""A person who types docs/first_evening.md command by command: commands are taken from the page, questions are
answered.

The arm is a fake one behind a pseudo-terminal, its joints are moved with `hil hand`, and every command is a separate
process on a terminal, as on a real evening. Only the name of the serial port is replaced.
"""

import contextlib
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.paths import ROOT
from tests.support.processes import forked

PAGE = ROOT / "docs" / "first_evening.md"
PORT_ON_THE_PAGE = "/dev/ttyUSB0"
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_QUESTION = re.compile(r"(?P<asked>[^\n\r]+?)(?: \[[^\]\n]*\])?: ?$")
_STYLING = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r(?!\n)")
_NEXT = re.compile(r"^Next: (hil .*)$", re.MULTILINE)
COLUMNS = 100


def commands_of(page: Path = PAGE) -> list[list[str]]:
    """Every command of the page's shell blocks, split into words, in order."""
    lines = [line for block in _BLOCK.findall(page.read_text(encoding="utf-8")) for line in block.splitlines()]
    return [shlex.split(line) for line in lines if line.strip()]


@dataclass
class Typed:
    """One command as it was typed, and its outcome; text: what the terminal showed, without its styling."""

    words: list[str]
    code: int
    text: str
    seconds: float

    @property
    def next(self) -> list[str] | None:
        """The command that its output names as the next one."""
        found = _NEXT.findall(self.text.replace("\r", ""))
        return shlex.split(found[-1]) if found else None


@dataclass
class Person:
    """Types in `folder`, and moves the joints of the fake arm at `port`: a device, or a fake:// URL.

    Behind a URL the arm exists in virtual time and only while a command runs, so no hand can move it.

    rest: joint angles at which the arm hangs [rad]. lengths_mm: as measured with a ruler, by joint. swings_deg: how far
    each joint may swing. forked: whether the commands are forked from a process that has imported their libraries.
    """

    folder: Path
    port: str
    rest: Sequence[float] = (-np.pi / 2, 0.0)
    lengths_mm: Sequence[str] = ("147", "180")
    swings_deg: Sequence[str] = ("120", "150")
    forked: bool = False
    asked: list[str] = field(default_factory=list)

    def type(self, words: Sequence[str], patience_s: float = 900.0) -> Typed:
        """Type one command and answer its questions until it ends. Raises TimeoutError."""
        typed = [self.port if word == PORT_ON_THE_PAGE else word for word in words]
        began = time.monotonic()
        with _terminal(typed, self.folder, self.forked) as (process, terminal):
            text = self._attend(process, terminal, began + patience_s)
        return Typed(list(words), process.returncode, text, time.monotonic() - began)

    def _attend(self, process: Any, terminal: int, deadline: float) -> str:
        text, answered = "", 0
        while True:
            if time.monotonic() > deadline:
                raise TimeoutError(f"not finished in time: {text[-500:]}")
            ready, _, _ = select.select([terminal], [], [], 0.2)
            if ready:
                try:
                    heard = os.read(terminal, 65536)
                except OSError:  # Linux: the last process that had the terminal open is gone
                    heard = b""
                if not heard:
                    process.wait(timeout=60)
                    return text
                text += _STYLING.sub("", heard.decode("utf-8", "replace"))
            elif (question := _QUESTION.search(text[answered:])) is not None:
                asked = question["asked"].strip()
                self.asked.append(asked)
                answered = len(text)
                os.write(terminal, f"{self._answer(asked)}\n".encode())

    def _answer(self, question: str) -> str:
        """What a person would do and type; an empty answer accepts the default."""
        if "change Return Delay Time" in question:
            return "y"
        by_hand = "://" not in self.port
        joint = 1 if "elbow" in question.split(" to ", maxsplit=1)[0] else 0
        if "counter-clockwise" in question and by_hand:
            self._hand(f"{joint + 1}:to={self.rest[joint] + 0.4:.3f},duration=0.5")
            time.sleep(1.0)
        elif "Let the arm hang" in question and by_hand:
            self._hand("--release", "1", "--release", "2")
            time.sleep(4.0)
        elif question.startswith("Length from"):
            return self.lengths_mm[joint]
        elif question.startswith("How far may"):
            return self.swings_deg[joint]
        return ""

    def _hand(self, *words: str) -> None:
        command = [sys.executable, "-m", "hil", "hand", self.port, *words]
        subprocess.run(command, check=True, cwd=self.folder, env=_environment())


@contextlib.contextmanager
def fake_arm(config: Path, link: Path) -> Iterator[subprocess.Popen[str]]:
    """`hil fake CONFIG --pty --link LINK`, until the block ends."""
    words = [sys.executable, "-m", "hil", "fake", "-q", str(config), "--pty", "--link", str(link)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=_environment())
    try:
        assert process.stdout is not None
        process.stdout.readline()  # it prints the link when it serves
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=30)


@contextlib.contextmanager
def _terminal(words: Sequence[str], folder: Path, fork: bool) -> Iterator[tuple[Any, int]]:
    """Start `hil ...` on a new pseudo-terminal; yields the process and the terminal's other end."""
    ours, theirs = pty.openpty()
    try:
        options: Any = {"stdin": theirs, "stdout": theirs, "stderr": theirs, "cwd": folder, "env": _environment()}
        options["start_new_session"] = True
        process = (
            forked.start(words, **options) if fork else subprocess.Popen([sys.executable, "-m", *words], **options)
        )
    finally:
        os.close(theirs)
    try:
        yield process, ours
    finally:
        os.close(ours)
        if process.poll() is None:
            process.kill()
            process.wait()


def _environment() -> dict[str, str]:
    known = {**os.environ, "COLUMNS": str(COLUMNS), "TERM": "xterm", "PYTHONPATH": str(ROOT)}
    return known | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def evening(
    person: Person, commands: Sequence[list[str]], tell: Callable[[Typed], None] = lambda _: None
) -> list[Typed]:
    """Type the commands one after the other; ends after the first that fails."""
    done: list[Typed] = []
    for words in commands:
        done.append(person.type(words))
        tell(done[-1])
        if done[-1].code:
            break
    return done


def faults_of(done: Sequence[Typed], commands: Sequence[list[str]]) -> list[str]:
    """What is wrong with an evening: commands that fail, tracebacks, and next commands that the page does not have."""
    found = [f"{shlex.join(each.words)}: exit code {each.code}" for each in done if each.code]
    found += [f"{shlex.join(each.words)}: a traceback" for each in done if "Traceback" in each.text]
    found += [f"{shlex.join(each)}: not reached" for each in commands[len(done) :]]
    for each in done:
        if each.words[1] == "export":
            continue
        if each.next is None:
            found.append(f"{shlex.join(each.words)}: names no next command")
        elif not any(_same(each.next, later) for later in commands):
            found.append(f"{shlex.join(each.words)}: names {shlex.join(each.next)}, which is not on the page")
    return found + _dead_end(done)


def _dead_end(done: Sequence[Typed]) -> list[str]:
    """Following only the named commands must lead from the scan to the export."""
    by_command = {each.words[1]: each for each in done}
    here, seen = "scan", ["scan"]
    while here != "export":
        typed = by_command.get(here)
        here = typed.next[1] if typed is not None and typed.next is not None else ""
        if not here or here in seen:
            return [f"the named commands end after {' -> '.join(seen)}"]
        seen.append(here)
    return []


def _same(named: Sequence[str], on_page: Sequence[str]) -> bool:
    """Whether a named command is one of the page's, which may have more options."""
    rest = iter(word for word in on_page if word != PORT_ON_THE_PAGE)
    return all(word in rest for word in named if not word.startswith(("/", "fake:")))


def arm_seconds(run: Path, rate: float) -> float:
    """Time for which the arm was driven in all steps of a run [s]."""
    return sum(len(np.load(path, mmap_mode="r")) for path in run.rglob("samples.npy")) / rate
