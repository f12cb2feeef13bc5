"""SIGKILL at random moments of an experiment on a pty, whose fake servos live in another process.

    python benchmarks/kills.py [--kills N] [--json]

105 ms after each kill, the servos are asked over the same terminal: each Bus Watchdog must have tripped and each Goal
Current be 0. The 5 ms are for this computer's own scheduling; a question that came earlier would feed the watchdog.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from random import Random

from drivers.bus import ServoBus
from hil.config import Config, parse_config
from hil.experiment import run_experiment
from hil.run_folder import RunFolder

CONFIG = Path(__file__).parents[1] / "configs" / "fake_two_link.toml"
ASKED_AFTER_S = 0.105
RECOVERY_S = 1.5
"""For the arm to hang still again."""


@dataclass(frozen=True)
class Kill:
    """watchdogs, torque, goals: what the servos' registers read. died_before: the run had ended by itself, for example
    because this computer kept it from its deadlines.
    """

    watchdogs: list[int]
    torque: list[int]
    goals: list[int]
    died_before: bool

    @property
    def safe(self) -> bool:
        """Torque was on when the kill came for most; then only a tripped watchdog will do."""
        stopped = [
            watchdog in {-1, 255} or not torque for watchdog, torque in zip(self.watchdogs, self.torque, strict=True)
        ]
        return all(stopped) and not any(self.goals)


def kill_campaign(kills: int, folder: Path, seed: int = 1) -> list[Kill]:
    """Kill a child process that runs an experiment on the pty, `kills` times."""
    random = Random(seed)
    link = folder / "arm"
    server = subprocess.Popen(
        [sys.executable, "-m", "hil", "fake", str(CONFIG), "--pty", "--link", str(link), "--quiet"],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[1],
    )
    try:
        assert server.stdout is not None
        server.stdout.readline()
        config = pty_config(link)
        done: list[Kill] = []
        for number in range(3 * kills):
            done.append(_kill_once(config, folder / f"run-{number}", random))
            if sum(not each.died_before for each in done) == kills:
                break
        return done
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(timeout=10)


def pty_config(link: Path) -> Config:
    text = CONFIG.read_text(encoding="utf-8")
    for old, new in (
        ('url = "fake://" ', f'url = "{link}" '),
        ("rate = 400.0 ", "rate = 200.0 "),
        ("[experiment]", "[safety]\nmax_late = 15\nmax_missing = 15\n\n[experiment]"),
        ("rest_pose", "rest_tolerance = 0.3\nrest_pose"),
    ):
        text = text.replace(old, new, 1)
    return parse_config(text, CONFIG)


def _kill_once(config: Config, folder: Path, random: Random) -> Kill:
    time.sleep(RECOVERY_S)
    run = RunFolder.create(folder, config)
    child = os.fork()
    if child == 0:
        try:
            run_experiment(config, run, CONFIG, lambda _: None)
        finally:
            os._exit(1)
    _wait_for_torque(run)
    time.sleep(random.uniform(0.0, 1.5))
    died_before = os.waitpid(child, os.WNOHANG)[0] != 0
    if not died_before:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    time.sleep(ASKED_AFTER_S)
    with ServoBus.connect(config.bus) as bus:
        servos = [bus.servo(joint) for joint in bus.joints]
        watchdogs = [servo.read("Bus Watchdog") for servo in servos]
        torque = [servo.read("Torque Enable") for servo in servos]
        goals = [servo.read("Goal Current") for servo in servos]
        for servo in servos:
            servo.write("Torque Enable", 0)
    return Kill(watchdogs, torque, goals, died_before)


def _wait_for_torque(run: RunFolder) -> None:
    events = run.path / "events.jsonl"
    for _ in range(2000):
        if events.is_file() and "torque on" in events.read_text(encoding="utf-8"):
            return
        time.sleep(0.005)
    raise AssertionError("the experiment on the pty never switched torque on")


def main() -> None:
    from machine import machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        done = kill_campaign(options.kills, Path(folder))
    measured = {"kills": sum(not each.died_before for each in done), "not_stopped": sum(not each.safe for each in done)}
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:12s} {value}")


if __name__ == "__main__":
    main()
