"""A `hil` command that is interrupted at a given stage: it sends itself a signal there, as a person or a system would.

    python -m tests.support.stops.interrupted ramp SIGINT identify arm.toml --out run

The stage is reached when a function is called, or when a sample of some phase is recorded, so that the moment is exact
and no time is lost; the signal is a real one, and everything after it is up to the program.
"""

import atexit
import contextlib
import importlib
import io
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.runs.recording import Phase
from tests.support.paths import ROOT

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Stage:
    """Where a command is interrupted.

    command: the subcommand. target: "module:name" or "module:Class.name" of the function whose call begins the stage,
    after `after` other calls. sampled: instead, whether a sample belongs to the stage, given phase, segment, period and
    the number of samples of that phase so far. pilot: whether it exists only with experiment.pilot = true.
    """

    command: str
    target: str = ""
    after: int = 0
    sampled: Callable[[Phase, int, int, int], bool] | None = None
    pilot: bool = False


def _in(phase: Phase, segment: int = 0, least: int = 5) -> Callable[[Phase, int, int, int], bool]:
    return lambda now, played, _, count: now is phase and played == segment and count >= least


STAGES: dict[str, Stage] = {
    "opening the port": Stage("identify", "hil.drivers.bus:open_port"),
    "scan": Stage("scan", "hil.setup.scan:listen"),
    "check": Stage("check", "hil.setup.preflight:check_rate"),
    "dry run": Stage("dry-run", "hil.dry_run.prediction:_peaks"),
    "first pilot": Stage("identify", sampled=_in(Phase.PERIODIC), pilot=True),
    "between pilots": Stage("identify", "hil.pilot.belief:Belief.after", pilot=True),
    "ramp": Stage("identify", sampled=_in(Phase.RAMP_IN)),
    "settling": Stage("identify", sampled=_in(Phase.PERIODIC)),
    "recorded period": Stage(
        "identify", sampled=lambda now, played, period, _: (now, played, period) == (Phase.PERIODIC, 0, 1)
    ),
    "held-out part": Stage("identify", sampled=_in(Phase.PERIODIC, 1)),
    "ramp out": Stage("identify", sampled=_in(Phase.RAMP_OUT, 1)),
    "first stage of the estimation": Stage("identify", "hil.estimation.settled_estimate:settled_period"),
    "choice": Stage("identify", "hil.estimation.settled_estimate:_estimate"),
    "held-out check": Stage("identify", "hil.estimation.settled_estimate:validate"),
    "report": Stage("identify", "hil.report.page:write_whole"),
    "export": Stage("export", "hil.export.mjcf:write_text"),
}


def interrupt_at(stage: Stage, number: signal.Signals) -> None:
    """Arrange for this process to receive the signal once, at the stage."""
    sent = [False]

    def send() -> None:
        if not sent[0]:
            sent[0] = True
            print("interrupted", file=sys.stderr)
            os.kill(os.getpid(), number)

    if stage.sampled is not None:
        _watch_samples(stage.sampled, send)
        return
    module, _, path = stage.target.partition(":")
    holder: Any = importlib.import_module(module)
    *outer, name = path.split(".")
    for each in outer:
        holder = getattr(holder, each)
    original = getattr(holder, name)
    calls = [0]

    def called(*args: Any, **options: Any) -> Any:
        calls[0] += 1
        if calls[0] > stage.after:
            send()
        return original(*args, **options)

    setattr(holder, name, called)


def _watch_samples(wanted: Callable[[Phase, int, int, int], bool], send: Callable[[], None]) -> None:
    from hil.runs.recording import Recorder

    original = Recorder.keep
    counts: dict[tuple[Phase, int], int] = {}

    def keep(self: Recorder, deadline: float, phase: Phase, segment: int, period: int, state: Any) -> None:
        original(self, deadline, phase, segment, period, state)
        counts[phase, segment] = counts.get((phase, segment), 0) + 1
        if wanted(phase, segment, period, counts[phase, segment]):
            send()

    Recorder.keep = keep  # type: ignore[method-assign]


def _report_servos() -> None:
    """At the end of the process, report the state in which it leaves the servos: a fake arm exists only as long as
    the process.
    """
    from hil.fakes.bus.bus import FakeBus

    original, buses = FakeBus.__init__, []

    def kept(self: FakeBus, *args: Any, **options: Any) -> None:
        original(self, *args, **options)
        state = {each.id: each.memory.get("Operating Mode") for each in self.servos.values()}
        buses.append((self, state))

    def tell() -> None:
        for bus, before in buses:
            for servo in bus.servos.values():
                torque, mode = servo.memory.get("Torque Enable"), servo.memory.get("Operating Mode")
                if torque or mode != before[servo.id]:
                    print(f"left behind: servo {servo.id}: torque {torque}, mode {mode}", file=sys.stderr)

    FakeBus.__init__ = kept  # type: ignore[method-assign]
    atexit.register(tell)


@dataclass(frozen=True)
class Interrupted:
    """A command that was interrupted. next: the command that its messages name; then: its exit code and output."""

    code: int
    said: str
    next: list[str]
    then: tuple[int, str] | None

    def faults(self, number: signal.Signals) -> list[str]:
        """What is wrong with how it ended."""
        found = [text for text in ("Traceback", "left behind") if text in self.said]
        if "interrupted" not in self.said:
            found.append("the stage was not reached")
        if self.code != 128 + number:
            found.append(f"exit code {self.code}")
        if self.then is None:
            found.append("no next command")
        elif self.then[0]:
            found.append(f"{' '.join(self.next)}: exit code {self.then[0]}: {self.then[1][-300:]}")
        return found


def interrupt(stage: str, number: signal.Signals, words: list[str], folder: Path) -> Interrupted:
    """Run a command in a process in `folder`, interrupt it, and run the command that it names then in this one.

    The process is a new interpreter for a Ctrl-C, which an interpreter handles itself, and a forked one otherwise.
    """
    from tests.support.processes import forked  # which a new interpreter does without

    command = ["tests.support.stops.interrupted", stage, number.name, *words]
    options: Any = {"cwd": folder, "env": ENVIRONMENT, "capture_output": True, "text": True, "timeout": 600}
    done = (
        subprocess.run([sys.executable, "-m", *command], **options, check=False)
        if number == signal.SIGINT
        else forked.run(command, **options)
    )
    named = [line for line in done.stderr.splitlines() if line.startswith("Next: hil ")]
    following = shlex.split(named[-1].removeprefix("Next: ")) if named else []
    return Interrupted(done.returncode, done.stderr, following, _run(following[1:], folder) if following else None)


def _run(words: list[str], folder: Path) -> tuple[int, str]:
    from tests.support.command_line import hil  # with pytest, which the interrupted process does without

    said = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        return hil(*words), said.getvalue()


def main() -> None:
    """Run `hil` with the arguments that follow the stage and the signal."""
    name, number, *words = sys.argv[1:]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start with it ignored
    _report_servos()
    interrupt_at(STAGES[name], signal.Signals[number])
    sys.argv = ["hil", *words]
    from hil.cli.app import main as hil

    hil()


if __name__ == "__main__":
    main()
