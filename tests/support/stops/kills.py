"""Kills of a program that runs an experiment on a pty; benchmarks/safety/kills.py turns them into a campaign."""

import os
import signal
import subprocess
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

from hil.config.schema import Config, parse_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.experiment.run import run_experiment
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import CONFIGS, ROOT
from tests.support.processes import forked

CONFIG = CONFIGS / "fake_two_link.toml"
ASKED_AFTER_S = 0.105
ANSWERED_BEFORE_S = 0.120
LONGEST_S = 2.6
"""Longest time from torque on to a kill [s]: rest, ramp in, settling and recorded period, ramp out."""
START_UP_S = 60.0
PATIENCE = 50
PRIORITY = 30
"""SCHED_FIFO priority of the fake arm, above hil's own."""


@dataclass(frozen=True)
class Kill:
    """The outcome of one kill.

    watchdogs, torque, goals: register values of the servos. answered_after: time from the kill to the answer about the
    watchdogs [s]. ended: message if the run had ended by itself before the kill.
    """

    watchdogs: list[int]
    torque: list[int]
    goals: list[int]
    answered_after: float
    ended: str = ""

    def counts(self, answered_before: float = ANSWERED_BEFORE_S) -> bool:
        return not self.ended and self.answered_after <= answered_before

    @property
    def safe(self) -> bool:
        """Whether every servo has no torque, or a tripped watchdog and a goal of 0."""
        servos = zip(self.watchdogs, self.torque, self.goals, strict=True)
        return all(not torque or (watchdog in {-1, 255} and goal == 0) for watchdog, torque, goal in servos)


def kill_campaign(kills: int, folder: Path, seed: int = 1, answered_before: float = ANSWERED_BEFORE_S) -> list[Kill]:
    """Kill child processes that run an experiment on the pty until `kills` of them count; all kills are returned.

    answered_before: time after a kill [s] within which the servos must have answered for it to count.

    Raises RuntimeError if too few kills count, with the messages of the experiments.
    """
    random = Random(seed)
    done: list[Kill] = []
    for number in range(3 * kills):
        place = folder / f"kill-{number}"
        place.mkdir()
        with fake_arm(place / "arm"):
            done.append(_kill_once(pty_config(place / "arm"), place, random.uniform(0.0, LONGEST_S)))
        if sum(kill.counts(answered_before) for kill in done) == kills:
            return done
    ended = [kill.ended for kill in done if kill.ended]
    raise RuntimeError(
        f"{sum(kill.counts(answered_before) for kill in done)} of {len(done)} kills count, {kills} are needed; "
        "is the computer busy? "
        f"Latest answer {max(1e3 * kill.answered_after for kill in done):.0f} ms after a kill; {len(ended)} "
        "runs ended by themselves, with:\n" + "\n".join(sorted(set(ended)))
    )


@contextmanager
def fake_arm(link: Path) -> Iterator[None]:
    """Serve a fake arm on a pty from another process."""
    words = ["hil", "fake", str(CONFIG), "--pty", "--link", str(link), "--quiet"]
    server = forked.start(words, stdout=subprocess.PIPE, cwd=ROOT)
    try:
        assert server.stdout is not None
        server.stdout.readline()
        with suppress(PermissionError):
            os.sched_setscheduler(server.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
        yield
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(timeout=10)
        if server.stdout is not None:
            server.stdout.close()


def pty_config(link: Path) -> Config:
    """The configuration of the fake arm on that terminal, with an experiment of about three seconds."""
    text = CONFIG.read_text(encoding="utf-8")
    text = replaced(
        text,
        ('url = "fake://" ', f'url = "{link}" '),
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "period = 1.0 "),
        ("band = [0.1, 5.0]", "band = [1.0, 6.0]"),
        ("ramp = 1.0 ", "held_out = false\nsettle_within = 0.5\nrest = 0.2\nramp = 0.2 "),
        ("[experiment]", "[safety]\nmax_late = 15\nmax_missing = 15\n\n[experiment]"),
    )
    return parse_config(text, CONFIG)


def _kill_once(config: Config, folder: Path, wait: float) -> Kill:
    """Start an experiment, kill it `wait` seconds after torque was switched on, and read the servos."""
    run = RunFolder.create(folder / "run", config)
    ending = folder / "ending.txt"
    child = _start(config, run, ending)
    started = _torque_came_on(run, ending)
    if started:
        time.sleep(wait)
    ended = ending.is_file()
    killed = time.monotonic()
    if not ended:
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    time.sleep(max(0.0, killed + ASKED_AFTER_S - time.monotonic()))
    with ServoBus.connect(config.bus) as bus:
        watchdogs = _ask(bus, "Bus Watchdog")
        answered = time.monotonic()
        torque, goals = _ask(bus, "Torque Enable"), _ask(bus, "Goal Current")
    why = ending.read_text(encoding="utf-8") if ended else "" if started else "Torque did not come on."
    return Kill(watchdogs, torque, goals, answered - killed, why)


def _ask(bus: ServoBus, register: str) -> list[int]:
    """Value of a register for each joint; retries, because a busy computer may miss replies."""
    for _ in range(PATIENCE):
        with suppress(DriverError):
            return [bus.servo(joint).read(register) for joint in bus.joints]
    raise RuntimeError(f"The servos on the pty do not return their {register}.")


def _start(config: Config, run: RunFolder, ending: Path) -> int:
    """Start a child that runs the experiment and writes its final message to `ending`; return its process ID."""
    child = os.fork()
    if child == 0:
        try:
            said = run_experiment(config, run, CONFIG, lambda _: None)
        except BaseException:
            said = traceback.format_exc()
        ending.write_text(said, encoding="utf-8")
        os._exit(0)
    return child


def _torque_came_on(run: RunFolder, ending: Path) -> bool:
    """Wait until torque is on; false if the run ended before."""
    events = run.path / "events.jsonl"
    give_up = time.monotonic() + START_UP_S
    while time.monotonic() < give_up and not ending.is_file():
        if events.is_file() and "torque on" in events.read_text(encoding="utf-8"):
            return True
        time.sleep(0.005)
    return False
