"""Benchmark of one control cycle of hil and of other clients, over a pty with the same C responder at the far end.

    python benchmarks/bus_cycle.py            prints tables and ratios
    python benchmarks/bus_cycle.py --json     one JSON object on standard output and nothing else

Each cycle is a Sync Write of 2 bytes and a Sync Read of 10 bytes with 2 servos (`--servos`). The clients alternate in
short rounds, so that variations of the machine's speed affect all of them. The results are medians over the rounds; the
ratios are medians of the ratios of each round. A pty has no wire: "answered at once" shows the cost of the client
alone; for "1 Mbaud", the responder waits as long as the bytes would take at 1 Mbaud. Absolute figures depend on the
machine; compare the ratios.

rustypot is optional (`pip install ".[bench]"`); its ratios are null without it.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from benchmarks.bus.served_pty import responder_binary, served_pty
from benchmarks.machine import machine
from hil.config.schema import load_config
from hil.drivers.control_table import load_control_table
from hil.drivers.exchange import Exchange
from hil.drivers.port import open_port
from hil.drivers.servo_model import Mode
from hil.drivers.state import Converter, spans

BAUD = 1_000_000
BYTE_NS = 10_000
PARTS = 3
PATIENCE_S = 2.0
"""Reply timeout [s], long enough that late replies on a busy machine do not count as lost."""

STILL_A = 0.01
"""A current too small to overcome dry friction [A]."""

GOAL_CURRENT, PRESENT = (102, 2), (126, 10)

Cycle = Callable[[], object]


class Round(NamedTuple):
    """One round of one client: CPU time per cycle [us], median round trip [us], cycles per second."""

    cpu_us: float
    p50_us: float
    rate: float


@contextmanager
def ours(name: str, servos: int, *, fast: bool = False) -> Iterator[Cycle]:
    """The driver's exchange with raw ticks, for comparison with the other clients."""
    port = open_port(name, BAUD)
    port.latency = PATIENCE_S
    exchange = make_exchange(port, servos, fast=fast)
    goals = (100,) * servos  # a tuple, as `Converter.ticks` returns

    def cycle() -> None:
        assert None not in exchange.cycle(goals).servos

    yield cycle
    port.close()


def make_exchange(port: Any, servos: int, *, fast: bool = False) -> Exchange:
    tables = [load_control_table("XM430-W350")] * servos
    every = spans(Mode.CURRENT, tables)
    ids = range(1, servos + 1)
    return Exchange(port, ids, tables[0]["Goal Current"], every, 0.0, fast=fast, slow_every=10**9)


@contextmanager
def whole_sample(name: str, servos: int) -> Iterator[Cycle]:
    """The complete work of an experiment for one sample: exchange in SI units, recorder, guard, and the model watch,
    which supports up to two joints.

    The simulated arm hangs at rest, since the currents are too small to move it, so the guard has nothing to stop.
    """
    from hil.experiment.guard import Guard
    from hil.experiment.model_watch import ModelWatch
    from hil.runs.recording import Phase, Recorder

    config = load_config(Path(__file__).parents[1] / "configs" / "fake_two_link.toml")
    given = [config.joints[index % 2] for index in range(servos)]
    joints = [replace(joint.joint, id=index) for index, joint in enumerate(given, 1)]
    safety = config.safety.model_copy(update={"watchdog": PATIENCE_S + 0.5})
    guard = Guard(config.model_copy(update={"joints": given, "safety": safety}), [STILL_A] * servos)
    model = ModelWatch(config, [STILL_A] * 2) if servos == 2 else None
    port = open_port(name, BAUD)
    port.latency = PATIENCE_S
    exchange = make_exchange(port, servos)
    converter = Converter(joints, [joint.drive_unit(12.0) for joint in joints])
    goals = [STILL_A] * servos
    with ExitStack() as stack:
        folder = stack.enter_context(_temporary_folder())
        recorder = stack.enter_context(Recorder(folder / "samples.npy", servos, 1_000_000))

        def cycle() -> None:
            ticks = converter.ticks(guard.clamp(goals))
            state = converter.state(ticks, exchange.cycle(ticks))
            recorder.keep(state.time_before_write, Phase.PERIODIC, 0, 0, state)
            guard.look(state)
            if model is not None:
                model.look(state)

        yield cycle
    port.close()


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@contextmanager
def sdk(name: str, servos: int) -> Iterator[Cycle]:
    """dynamixel-sdk as in its examples: GroupSyncWrite, then GroupSyncRead."""
    port = PortHandler(name)
    assert port.openPort() and port.setBaudRate(BAUD)
    packets = PacketHandler(2.0)
    write = GroupSyncWrite(port, packets, *GOAL_CURRENT)
    read = GroupSyncRead(port, packets, *PRESENT)
    ids = range(1, servos + 1)
    for servo_id in ids:
        read.addParam(servo_id)

    def cycle() -> None:
        for servo_id in ids:
            write.addParam(servo_id, b"\x64\x00")
        write.txPacket()
        write.clearParam()
        while read.txRxPacket() != 0:
            pass  # it waits 34 ms, which a busy machine can exceed
        for servo_id in ids:
            read.getData(servo_id, 126, 2), read.getData(servo_id, 128, 4), read.getData(servo_id, 132, 4)

    yield cycle
    port.closePort()


@contextmanager
def rustypot(name: str, servos: int) -> Iterator[Cycle]:
    """rustypot's raw sync write and sync read."""
    from rustypot import Xl330PyController

    controller = Xl330PyController(name, BAUD, PATIENCE_S)
    ids = list(range(1, servos + 1))
    data = [b"\x64\x00"] * servos

    def cycle() -> None:
        controller.sync_write_raw_data(ids, GOAL_CURRENT[0], data)
        assert len(controller.sync_read_raw_data(ids, *PRESENT)) == servos

    cycle()
    yield cycle


def play(cycle: Cycle, count: int) -> Round:
    """Run one round of a client in this process."""
    trips = np.empty(count)
    clock = time.perf_counter
    cpu, start = time.process_time(), clock()
    for index in range(count):
        before = clock()
        cycle()
        trips[index] = clock() - before
    whole = clock() - start
    return Round((time.process_time() - cpu) / count * 1e6, float(np.median(trips)) * 1e6, count / whole)


def play_c(binary: Path, name: str, servos: int, count: int, writes: int) -> Round:
    """Run one round of the client written in C."""
    words: list[str | Path] = [binary, "client", name, str(servos), str(count), str(writes)]
    text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    cpu, p50, each = map(int, text.split())
    return Round(cpu / 1e3, p50 / 1e3, 1e9 / each)


def available() -> dict[str, Any]:
    clients = {"ours": ours, "ours, Fast Sync Read": lambda *a: ours(*a, fast=True), "ours, whole sample": whole_sample}
    clients["dynamixel-sdk"] = sdk
    try:
        import rustypot as _  # noqa: F401
    except ImportError:
        return clients
    return clients | {"rustypot": rustypot}


Rounds = dict[str, list[Round]]


def measure(binary: Path, servos: int, byte_ns: int, rounds: int, count: int) -> Rounds:
    """Run all clients in turn; every round starts with a different one."""
    # The position in the responder's answers alternates by one tick, and the guard's sum of work omits the motion
    # between two rounds; with an odd number of cycles, the omitted parts cancel.
    count |= 1
    results: Rounds = {}
    with ExitStack() as stack:
        cycles = {}
        for name, client in available().items():
            device = stack.enter_context(served_pty(binary, byte_ns))
            cycles[name] = stack.enter_context(client(device, servos))
            play(cycles[name], 50)
        device = stack.enter_context(served_pty(binary, byte_ns))
        turns = [(name, partial(play, cycle, count)) for name, cycle in cycles.items()]
        for writes, name in ((1, "C, one write"), (2, "C, two writes")):
            turns.append((name, partial(play_c, binary, device, servos, count, writes)))
        for index in range(rounds):
            first = index % len(turns)
            for name, turn in turns[first:] + turns[:first]:
                results.setdefault(name, []).append(turn())
    return results


def add(results: Rounds, more: Rounds) -> None:
    for name, rounds in more.items():
        results.setdefault(name, []).extend(rounds)


def medians(results: Rounds) -> dict[str, Round]:
    return {name: Round(*map(statistics.median, zip(*many, strict=True))) for name, many in results.items()}


def report(at_once: Rounds, wired: Rounds, samples_cpu: dict[str, float]) -> dict[str, Any]:
    """The figures that are compared with the targets."""

    def compare(results: Rounds, other: str, figure: Callable[[Round, Round], float]) -> float | None:
        if other not in results:
            return None
        return round(statistics.median(map(figure, results["ours"], results[other])), 3)

    def cpu(ours: Round, other: Round) -> float:
        return ours.cpu_us / other.cpu_us

    def rate(ours: Round, other: Round) -> float:
        return ours.rate / other.rate

    return {
        "cpu_over_sdk": compare(wired, "dynamixel-sdk", cpu),
        "cpu_over_rustypot": compare(wired, "rustypot", cpu),
        "p50_above_c_us": compare(wired, "C, one write", lambda ours, other: ours.p50_us - other.p50_us),
        "rate_over_sdk": compare(at_once, "dynamixel-sdk", rate),
        "rate_over_rustypot": compare(at_once, "rustypot", rate),
        "whole_sample_cpu_us": samples_cpu,
        "at_once": {name: _rounded(each) for name, each in medians(at_once).items()},
        "wired": {name: _rounded(each) for name, each in medians(wired).items()},
        "machine": machine(),
    }


def _rounded(each: Round) -> dict[str, float]:
    return {name: round(value, 2) for name, value in each._asdict().items()}


def show(figures: dict[str, Any], servos: int) -> None:
    print(f"Sync Write + Sync Read, {servos} servos, over a pty. {figures['machine']}.\n")
    for title, key in (("answered at once", "at_once"), ("1 Mbaud", "wired")):
        print(f"{title:<24}{'CPU us':>10}{'p50 us':>10}{'cycles/s':>12}{'CPU / sdk':>12}")
        base = figures[key]["dynamixel-sdk"]["cpu_us"]
        for name, each in figures[key].items():
            shares = each["cpu_us"] / base
            print(f"  {name:<22}{each['cpu_us']:>10.1f}{each['p50_us']:>10.1f}{each['rate']:>12.0f}{shares:>12.3f}")
        print()
    for key in ("cpu_over_sdk", "cpu_over_rustypot", "p50_above_c_us", "rate_over_sdk", "rate_over_rustypot"):
        print(f"{key:<22}{figures[key]}")
    for count, cpu_us in figures["whole_sample_cpu_us"].items():
        print(f"whole sample, {count} servos: {cpu_us} us of CPU at 1 Mbaud")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    parser.add_argument("--servos", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=42, help="rounds at 1 Mbaud; twice as many without delay")
    parser.add_argument(
        "--cycles", type=int, default=100, help="cycles per round at 1 Mbaud; three times as many without delay"
    )
    options = parser.parse_args()
    with responder_binary() as binary:
        # Alternate between both cases too: the load from other virtual machines changes within half a minute.
        at_once: Rounds = {}
        wired: Rounds = {}
        for _ in range(PARTS):
            add(at_once, measure(binary, options.servos, 0, 2 * options.rounds // PARTS, 3 * options.cycles))
            add(wired, measure(binary, options.servos, BYTE_NS, options.rounds // PARTS, options.cycles))
        samples_cpu = {str(options.servos): round(medians(wired)["ours, whole sample"].cpu_us, 1)}
        with served_pty(binary, BYTE_NS) as device, whole_sample(device, 6) as cycle:
            each = [play(cycle, options.cycles).cpu_us for _ in range(options.rounds)]
        samples_cpu["6"] = round(statistics.median(each), 1)
    figures = report(at_once, wired, samples_cpu)
    if options.json:
        print(json.dumps(figures))
    else:
        show(figures, options.servos)


if __name__ == "__main__":
    main()
