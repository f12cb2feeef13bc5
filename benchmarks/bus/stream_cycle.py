"""Benchmark of hil's stream and the cycles of other clients at a fixed rate, each on its own fake bus.

    python benchmarks/bus/stream_cycle.py                          tables and ratios, 2 servos
    python benchmarks/bus/stream_cycle.py --config six.toml        another planar arm with [fake]
    python benchmarks/bus/stream_cycle.py --json                   one JSON object on standard output and nothing else

`benchmarks/bus_cycle.py` measures exchanges that follow each other without a pause. Here, `hil.experiment.stream` runs
as in an experiment: it waits for its deadlines (`Pace`), reads goals back before each sample, exchanges, checks and
records. Each fake bus is `hil fake --pty` in its own process, with the wire time of 1 Mbaud. The other clients write
goals and read states once per sample, with the same deadlines and real-time settings. Unlike an experiment, all clients
sleep until each deadline instead of spinning just before it, so the CPU time is that of the work alone. The clients
take turns; the ratios are medians over the rounds.

rustypot is optional (`pip install ".[bench]"`).
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bus.served_pty import prioritise
from benchmarks.bus_cycle import Cycle, ours, sdk
from benchmarks.machine import machine
from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.clock import WallClock
from hil.drivers.rate import FixedRate
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Stream
from hil.plan.plan import make_plan
from hil.runs.recording import Phase, Recorder
from hil.setup.realtime import real_time

CONFIG = Path(__file__).parents[2] / "configs" / "fake_two_link.toml"
REST_S = 1.5
"""Time given to the arm to come to rest after each round of the stream [s]."""


class Sleeping(WallClock):
    """A wall clock that does not busy-wait before a deadline."""

    def wait_until(self, deadline: float) -> None:
        time.sleep(max(0.0, deadline - self.now()))


class Round(NamedTuple):
    """One round of one client: CPU time per sample [us], share of missed deadlines, samples with missing replies."""

    cpu_us: float
    missed: float
    lost: int


Player = Callable[[int], Round]


@contextmanager
def fake_pty(config: Path, *, real_time: bool = False) -> Iterator[str]:
    """Run `hil fake` on a pseudo-terminal and yield its name. real_time: give the fake priority over ordinary programs,
    and the first core, if that is permitted.
    """
    command = [sys.executable, "-m", "hil", "fake", str(config), "--pty", "--quiet"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if real_time:
            prioritise(process.pid)
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()


@contextmanager
def stream(device: str, config: Config) -> Iterator[Player]:
    """Play the beginning of an experiment: switch torque on, then play the first samples of the ramp."""
    config = config.model_copy(update={"port": config.port.model_copy(update={"url": device})})
    plan = make_plan(config)
    numbers = count()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bus = stack.enter_context(ServoBus.open(config.bus))
        bus.port.clock = Sleeping()

        def play(samples: int) -> Round:
            path = folder / f"{next(numbers)}.npy"
            with StopRequest() as stop, Recorder(path, len(config.joints), samples) as recorder:
                each = Stream(bus, plan, config, recorder, stop, lambda _: None, lambda _: None)
                with bus.torque(config.safety.watchdog):
                    started = time.process_time()
                    each._play(plan.segments[0].ramp_in[:samples], Phase.RAMP_IN)
                    cpu = time.process_time() - started
                rows = recorder.samples
                missed = float((rows["time_before_write"] == rows["time_after_read"]).mean())
                lost = int(rows["missing"].any(axis=1).sum())
            time.sleep(REST_S)
            return Round(cpu / samples * 1e6, missed, lost - round(missed * samples))

        yield play


def paced(cycle: Cycle, rate: float) -> Player:
    """A client that runs one cycle per sample."""

    def play(samples: int) -> Round:
        ticks = FixedRate(Sleeping(), rate)
        started = time.process_time()
        for _ in range(samples):
            ticks.wait()
            cycle()
        return Round((time.process_time() - started) / samples * 1e6, ticks.missed / samples, 0)

    return play


@contextmanager
def players(path: Path) -> Iterator[dict[str, Player]]:
    """All clients, each with its own fake arm."""
    config = load_config(path)
    rate, servos = config.experiment.rate, sum(len(joint.ids) for joint in config.joints)
    clients = {"ours, exchange": ours, "dynamixel-sdk": sdk}
    try:
        from rustypot import Xl330PyController as _  # noqa: F401

        from benchmarks.bus_cycle import rustypot

        clients["rustypot"] = rustypot
    except ImportError:
        pass
    with ExitStack() as stack:
        found = {"ours, stream": stack.enter_context(stream(stack.enter_context(fake_pty(path)), config))}
        for name, client in clients.items():
            cycle = stack.enter_context(client(stack.enter_context(fake_pty(path)), servos))
            found[name] = paced(cycle, rate)
        yield found


def measure(path: Path, rounds: int, samples: int) -> dict[str, list[Round]]:
    """Let all clients take turns; every round starts with a different one."""
    results: dict[str, list[Round]] = {}
    with players(path) as clients:
        turns = list(clients.items())
        for _, play in turns:
            play(samples)
        with real_time():
            for index in range(rounds):
                first = index % len(turns)
                for name, play in turns[first:] + turns[:first]:
                    results.setdefault(name, []).append(play(samples))
    return results


def report(results: dict[str, list[Round]]) -> dict[str, Any]:
    ours_us = [each.cpu_us for each in results["ours, stream"]]
    figures: dict[str, Any] = {"machine": machine(), "clients": {}}
    for name, rounds in results.items():
        ratios = [mine / other.cpu_us for mine, other in zip(ours_us, rounds, strict=True)]
        figures["clients"][name] = {
            "cpu_us": round(statistics.median(each.cpu_us for each in rounds), 1),
            "stream_over_it": round(statistics.median(ratios), 3),
            "missed": round(statistics.mean(each.missed for each in rounds), 4),
            "lost": sum(each.lost for each in rounds),
        }
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--samples", type=int, default=400, help="samples per round, at most those of the ramp")
    options = parser.parse_args()
    figures = report(measure(options.config, options.rounds, options.samples))
    if options.json:
        print(json.dumps(figures))
        return
    print(f"One sample at the rate of {options.config.name}, 1 Mbaud, fake bus on a pty. {figures['machine']}.\n")
    print(f"{'':<18}{'CPU us':>10}{'stream / it':>14}{'missed':>10}{'lost':>8}")
    for name, each in figures["clients"].items():
        shares = f"{each['cpu_us']:>10.1f}{each['stream_over_it']:>14.3f}"
        print(f"{name:<18}{shares}{each['missed']:>10.2%}{each['lost']:>8}")


if __name__ == "__main__":
    main()
