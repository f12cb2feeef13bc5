"""Computing time of the fake bus: in virtual time, with more servos, and with a program on the pty.

    python benchmarks/fake_bus.py [--json] [--seconds S] [--config CONFIG]

- `times_real_time`: hil's own stream (guard, recorder, drivers) on the realistic two-link arm at 400 Hz, in virtual
  time: arm time divided by CPU time, best of five runs. `bus_share_us`, `plant_share_us`: time of bus and plant per
  cycle.
- `servos_us`: one control cycle of the bus alone, with a trivial plant, for one to six servos.
- `pty_*`: `hil fake --pty` in a separate process, and a client in this process that writes goals and reads states 1000
  times a second for S seconds at 4 Mbaud (at 1 Mbaud, transferring the bytes of a cycle takes more than a millisecond).
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import serial

from benchmarks.machine import machine
from hil.config.schema import load_config
from hil.drivers.packet import BROADCAST_ID, Framer, Instruction, encode
from hil.experiment.run import run_experiment
from hil.experiment.stream import Stream
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.plants.two_link import TwoLink
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo
from hil.runs.run_folder import RunFolder

CONFIG = Path(__file__).parents[1] / "configs" / "fake_two_link.toml"
RATE = 1000


def streams(config_path: Path, runs: int) -> dict[str, float]:
    """Run the configuration's experiment `runs` times; return the best figures."""
    config = load_config(config_path)
    best: dict[str, float] = {}
    for _ in range(runs):
        spent = {"stream": 0.0}
        arm_seconds: list[float] = []
        with tempfile.TemporaryDirectory() as folder:
            run = RunFolder.create(Path(folder) / "run", config)
            undo = _timed_stream(spent, arm_seconds)
            run_experiment(config, run, config.path, lambda _: None)
            undo()
        cycles = arm_seconds[0] * config.experiment.rate
        figures = {
            "cycle_us": 1e6 * spent["stream"] / cycles,
            "times_real_time": arm_seconds[0] / spent["stream"],
        }
        if not best or figures["cycle_us"] < best["cycle_us"]:
            best = figures
    return best | _shares(config_path)


def _shares(config_path: Path) -> dict[str, float]:
    """Time spent in the bus and in the plant per cycle, from an additional run (timing a call takes 0.3 us)."""
    config = load_config(config_path)
    spent = {"stream": 0.0, "write": 0.0, "read": 0.0, "plant": 0.0}
    arm_seconds: list[float] = []
    undo = [
        _timed_stream(spent, arm_seconds),
        _timed(FakeBus, "write", spent, "write"),
        _timed(FakeBus, "read", spent, "read"),
        _timed(TwoLink, "advance", spent, "plant"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        run_experiment(config, RunFolder.create(Path(folder) / "run", config), config.path, lambda _: None)
    for back in undo:
        back()
    cycles = arm_seconds[0] * config.experiment.rate
    return {
        "bus_share_us": 1e6 * (spent["write"] + spent["read"] - spent["plant"]) / cycles,
        "plant_share_us": 1e6 * spent["plant"] / cycles,
    }


def _timed(cls: type, name: str, spent: dict[str, float], key: str) -> Callable[[], None]:
    """Wrap a method so that its duration is added to `spent[key]`; return a function that restores the original."""
    original = getattr(cls, name)

    def timed(self: Any, *args: Any) -> Any:
        started = time.perf_counter()
        try:
            return original(self, *args)
        finally:
            spent[key] += time.perf_counter() - started

    setattr(cls, name, timed)
    return lambda: setattr(cls, name, original)


def _timed_stream(spent: dict[str, float], arm_seconds: list[float]) -> Callable[[], None]:
    """Add the CPU time of `Stream.run` to `spent["stream"]`, and append the arm's time; return an undo function."""
    original = Stream.run

    def run(self: Stream) -> None:
        clock = self._bus.port.clock
        arm_started, started = clock.now(), time.process_time()
        try:
            original(self)
        finally:
            spent["stream"] += time.process_time() - started
            arm_seconds.append(clock.now() - arm_started)

    def undo() -> None:
        Stream.run = original  # type: ignore[method-assign]

    Stream.run = run  # type: ignore[method-assign]
    return undo


class Free:
    """Joints that take no computing time."""

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.position = self.velocity = self.current = (0.1,) * joints

    def advance(self, until: float, current: object) -> None:
        pass


def cycle_us(servos: int, cycles: int = 4000, repeats: int = 5) -> float:
    """One control cycle of the bus with this many servos and a trivial plant; median over the repeats [us]."""
    clock = VirtualClock()
    members = [
        EmulatedServo(load_model("XM430-W350"), number, registers={"Operating Mode": 0})
        for number in range(1, servos + 1)
    ]
    bus = FakeBus(members, Free(servos), clock)
    ids = range(1, servos + 1)
    goals = encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x66\0\x02\0" + b"".join(bytes((n, 5, 0)) for n in ids))
    request = goals + encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x7e\0\x0a\0" + bytes(ids))
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        for _ in range(cycles):
            clock.wait_until(clock.now() + 0.0025)
            bus.write(request)
            bus.read(21 * servos, 0.1)
        taken.append(1e6 * (time.perf_counter() - started) / cycles)
    return median(taken)


def pty(seconds: float) -> dict[str, float]:
    """Run a client at 1 kHz against `hil fake --pty` in another process."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "arm.toml"
        text = CONFIG.read_text(encoding="utf-8")
        config.write_text(text.replace("[[fake.servos]]\n", "[[fake.servos]]\nbaud = 4_000_000\n"), encoding="utf-8")
        command = [sys.executable, "-m", "hil", "fake", str(config), "--pty", "--quiet"]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            path = process.stdout.readline().decode().strip()
            before = _cpu_seconds(process.pid)
            figures = _client(path, seconds)
            cpu = _cpu_seconds(process.pid) - before
            process.send_signal(signal.SIGTERM)
    return figures | {"pty_cpu_share": cpu / seconds}


def _client(path: str, seconds: float) -> dict[str, float]:
    request = encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x66\0\x02\0\x01\x05\0\x02\x05\0")
    request += encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x7e\0\x0a\0\x01\x02")
    wrong = missed = 0
    trips = []
    with serial.Serial(path, 4_000_000, timeout=0.2) as port:
        started = time.perf_counter()
        cycles = round(seconds * RATE)
        for cycle in range(cycles):
            wait = started + cycle / RATE - time.perf_counter()
            if wait > 0:
                time.sleep(wait)
            elif wait < -1 / RATE:
                missed += 1  # late by a period: the machine was busy
            sent = time.perf_counter()
            port.write(request)
            raw = port.read(42)
            trips.append(time.perf_counter() - sent)
            replies = list(Framer().feed(raw))
            wrong += [(r.id, r.error, len(r.data)) for r in replies] != [(1, 0, 10), (2, 0, 10)]
        held = cycles / (time.perf_counter() - started)
    trips.sort()
    return {
        "pty_rate": held,
        "pty_wrong": wrong,
        "pty_late_cycles": missed,
        "pty_p50_us": 1e6 * trips[len(trips) // 2],
        "pty_p99_us": 1e6 * trips[int(0.99 * len(trips))],
    }


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--config", type=Path, default=CONFIG)
    options = parser.parse_args()
    figures: dict[str, Any] = streams(options.config, 5)
    figures["servos_us"] = {count: cycle_us(count) for count in (1, 2, 3, 4, 6)}
    figures |= pty(options.seconds)
    if options.json:
        print(json.dumps(figures))
        return
    print(machine())
    print(f"stream in virtual time: {figures['cycle_us']:.1f} us per cycle")
    print(f"  {figures['times_real_time']:.0f} times real time")
    print(f"  of which bus {figures['bus_share_us']:.1f} us, plant {figures['plant_share_us']:.1f} us")
    print("bus alone: " + ", ".join(f"{count}: {us:.1f} us" for count, us in figures["servos_us"].items()))
    print(f"pty: {figures['pty_rate']:.0f} cycles/s for {options.seconds:g} s, {figures['pty_wrong']} wrong replies")
    print(f"  {figures['pty_late_cycles']} cycles late by at least one period (including the client's own lateness)")
    print(f"  p50 {figures['pty_p50_us']:.0f} us, p99 {figures['pty_p99_us']:.0f} us")
    print(f"  CPU of the fake {100 * figures['pty_cpu_share']:.0f} % of a core")


if __name__ == "__main__":
    main()
