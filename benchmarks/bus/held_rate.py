"""Test whether an arm of four joints, two of which have a second servo, sustains 400 Hz at 1 Mbaud.

    python benchmarks/bus/held_rate.py [--seconds 20] [--rounds 3] [--fast | --plain] [--pty] [--json]

The arm is held at rest with torque on while the program does the same work as during an experiment: deadlines,
read-backs, exchanges with slow reads and status reads, checks, and recording. The servos run in another process, which
takes as long for each byte as the wire would. Both processes ask for real-time scheduling, each on its own core. They
are connected by a socket, which wakes the reader at once. With --pty, they are connected by a terminal, as with
`hil fake --pty`; the kernel forwards the bytes of a terminal in a thread of ordinary priority, so other programs may
delay them by milliseconds. As a virtual machine may also stall, the computer's load is printed. After each round, a
loop that has the same deadlines and real-time settings but only waits shows how many deadlines the computer misses on
its own. With --pty, a second such loop writes the bytes of an exchange and reads the reply from a responder in C, which
takes as long for each byte as the wire would; this loop has no driver, checks, slow reads or read-backs.

missed: number of missed deadlines. slow: number of missed deadlines for which the computer or the pty is to blame,
because the preceding exchange took over 1 ms longer than the wire needs. lost: number of samples with missing replies.
late: 99 % quantile and maximum of the time from a deadline to the write [ms]. took: median, 99 % quantile and maximum
of the round trip [ms]. work: median time from a reply to the next wait, which is spent on recording and checks [us].
"""

import argparse
import json
import os
import re
import sys
import tempfile
import tty
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

from benchmarks.bus.served_pty import responder_binary, served_pty
from benchmarks.bus.socket_line import DEVICE, socket_line
from benchmarks.bus.stream_cycle import fake_pty
from benchmarks.machine import machine
from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.clock import WallClock
from hil.drivers.packet import BROADCAST_ID, Instruction, encode
from hil.drivers.rate import FixedRate
from hil.errors import SafetyStop
from hil.experiment.chain_watch import ChainWatch
from hil.experiment.guard import Guard
from hil.experiment.pace import Pace
from hil.runs.recording import Phase, Recorder, missed
from hil.setup.realtime import real_time

CONFIGS = Path(__file__).parents[2] / "configs"
SERVOS = ((1, 1), (2, 2), (3, 2), (4, 3), (5, 3), (6, 4))  # ID, joint
RATE = 400.0
BYTE_NS = 10_000
SLOW_S = 1e-3
SMALL_A = 0.02
"""Planned peak current that is passed to the checks, although the arm is at rest all the time."""


def six_servos(folder: Path, baud: str = "1_000_000") -> Path:
    """Write the configuration of an arm of four joints, two of them with a second servo, at 400 Hz."""
    text = (CONFIGS / "open_manipulator_x.toml").read_text(encoding="utf-8")
    text = text.replace('urdf = "', f'urdf = "{CONFIGS}/').replace("baud = 1_000_000", f"baud = {baud}")
    text = re.sub(r"^rate = .*$", f"rate = {RATE}", text, flags=re.MULTILINE)
    real, fake = text.split("[fake]")
    ids = iter(("1", "[2, 3]", "[4, 5]", "6"))
    real = re.sub(r"^id = .*$", lambda _: f"id = {next(ids)}", real, flags=re.MULTILINE)
    before, after = fake.split("[[fake.servos]]")[0], fake[fake.index("[fake.chain]") :]
    servos = "".join(
        f'[[fake.servos]]\nid = {number}\njoint = {joint}\nmodel = "XM430-W350"\nbaud = {baud}\nzero_ticks = 2048\n'
        for number, joint in SERVOS
    )
    path = folder / "arm.toml"
    path.write_text(f"{real}[fake]{before}{servos}{after}", encoding="utf-8")
    return path


def held(device: str, config: Config, seconds: float, folder: Path) -> dict[str, Any]:
    """Hold the arm at rest once; return the figures for missed deadlines, lost replies and lateness."""
    config = config.model_copy(update={"port": config.port.model_copy(update={"url": device})})
    samples, count = round(seconds * RATE), len(config.joints)
    with ServoBus.open(config.bus) as bus, Recorder(folder / "samples.npy", count, samples) as recorder:
        exchange = bus.prepared
        guard = Guard(config, [SMALL_A] * count, patience=exchange.patience, heard_instead=lambda: bus.heard_instead)
        model = ChainWatch(config, [SMALL_A] * count)
        stopped, worked = "", list[float]()
        with real_time(), bus.torque(config.safety.watchdog):
            try:
                play(bus, guard, model, recorder, samples, worked)
            except SafetyStop as error:
                stopped = str(error)
        rows = recorder.samples.copy()
    is_missed = rows["time_before_write"] == rows["time_after_read"]
    sent = rows[~is_missed]
    late = 1e3 * (sent["time_before_write"] - sent["deadline"])
    took = 1e3 * (sent["time_after_read"] - sent["time_before_write"])
    return {
        "fast": exchange.fast,
        "wire_ms": round(1e3 * exchange.longest, 3),
        "samples": len(rows),
        "missed": int(is_missed.sum()),
        "slow": _behind_slow_ones(rows, is_missed, exchange.longest + SLOW_S),
        "lost": int(sent["missing"].any(axis=1).sum()),
        "late_ms": [round(float(each), 3) for each in (np.quantile(late, 0.99), late.max())],
        "took_ms": [round(float(each), 3) for each in (*np.quantile(took, (0.5, 0.99)), took.max())],
        "work_us": round(1e6 * float(np.median(worked))),
        "load": round(os.getloadavg()[0], 1),
        "stopped": stopped,
    }


def _behind_slow_ones(rows: Any, is_missed: Any, slow_s: float) -> int:
    """Number of missed deadlines whose preceding exchange took longer than `slow_s` [s]."""
    count, is_slow = 0, False
    for took, missed_it in zip(rows["time_after_read"] - rows["time_before_write"], is_missed, strict=True):
        if missed_it:
            count += bool(is_slow)
        else:
            is_slow = took > slow_s
    return count


def bare(seconds: float, device: str | None, *, fast: bool) -> int:
    """Return the number of deadlines missed by a loop that only waits or, given a device, only transfers bytes."""
    ids = bytes(number for number, _ in SERVOS)
    goals = bytes((102, 0, 2, 0)) + b"".join(bytes((number, 0, 0)) for number in ids)
    read = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    request = encode(BROADCAST_ID, Instruction.SYNC_WRITE, goals)
    request += encode(BROADCAST_ID, read, bytes((126, 0, 10, 0)) + ids)
    reply_size = 8 + 14 * len(ids) if fast else 21 * len(ids)
    with ExitStack() as stack:
        line = -1
        if device is not None:
            line = os.open(device, os.O_RDWR | os.O_NOCTTY)
            stack.callback(os.close, line)
            tty.setraw(line)
        stack.enter_context(real_time())
        ticks = FixedRate(WallClock(), RATE)
        for _ in range(round(seconds * RATE)):
            if ticks.wait().missed or line < 0:
                continue
            os.write(line, request)
            left = reply_size
            while left:
                left -= len(os.read(line, left))
        return ticks.missed


def play(bus: ServoBus, guard: Guard, model: ChainWatch, recorder: Recorder, samples: int, worked: list[float]) -> None:
    """Do the work of `hil.experiment.stream` at rest; append the time spent on each sample's work to `worked`."""
    pace, goal, sent_at = Pace(bus, RATE, guard), [0.0] * len(bus.joints), None
    for _ in range(samples):
        deadline, now, late = pace.wait()
        state = missed(goal, now) if late else pace.send(guard.clamp(goal))
        recorder.keep(deadline, Phase.REST, 0, -1, state)
        if late:
            guard.late(now - (deadline if pace.sent_at is None else pace.sent_at))
            continue
        guard.look(state, 0.0 if sent_at is None else state.time_before_write - sent_at)
        sent_at = state.time_before_write
        if state.status is not None and guard.wants_status:
            bus.read_status_next()
        model.look(state)
        worked.append(bus.port.clock.now() - state.time_after_read)


def configured(path: Path, *, fast: bool) -> Config:
    config = load_config(path)
    return config.model_copy(update={"port": config.port.model_copy(update={"fast_sync_read": fast})})


def measure(seconds: float, rounds: int, reads: tuple[bool, ...]) -> list[dict[str, Any]]:
    """Measure over a socket."""
    figures = []
    with tempfile.TemporaryDirectory() as name:
        path = six_servos(Path(name))
        for _ in range(rounds):
            for fast in reads:
                with socket_line(path):
                    figures.append(held(DEVICE, configured(path, fast=fast), seconds, Path(name)))
                figures[-1]["nothing_missed"] = bare(seconds, None, fast=fast)
    return figures


def measure_on_pty(seconds: float, rounds: int, reads: tuple[bool, ...]) -> list[dict[str, Any]]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = six_servos(folder)
        device = stack.enter_context(fake_pty(path, real_time=True))
        binary = stack.enter_context(responder_binary())
        figures = []
        for _ in range(rounds):
            for fast in reads:
                figures.append(held(device, configured(path, fast=fast), seconds, folder))
                figures[-1]["nothing_missed"] = bare(seconds, None, fast=fast)
                with served_pty(binary, BYTE_NS, real_time=True) as terminal:
                    figures[-1]["bytes_missed"] = bare(seconds, terminal, fast=fast)
        return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pty", action="store_true", help="over a terminal instead of a socket")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--fast", dest="reads", action="store_const", const=(True,), default=(True, False))
    kind.add_argument("--plain", dest="reads", action="store_const", const=(False,))
    options = parser.parse_args()
    figures = (measure_on_pty if options.pty else measure)(options.seconds, options.rounds, options.reads)
    if options.json:
        print(json.dumps({"machine": machine(), "rounds": figures}))
        return
    line = "pty" if options.pty else "socket"
    print(f"Six servos at {RATE:g} Hz and 1 Mbaud, fake bus on a {line}. {machine()}.")
    for each in figures:
        read = "Fast Sync Read" if each["fast"] else "Sync Read"
        print(
            f"{read:15s} longest exchange on the wire {each['wire_ms']:.2f} ms: missed {each['missed']} of "
            f"{each['samples']} ({each['slow']} slow), by a loop without bus {each['nothing_missed']}, by one of bytes "
            f"{each.get('bytes_missed', '-')}; lost {each['lost']}, late {each['late_ms']}, took {each['took_ms']}, "
            f"work {each['work_us']}, load {each['load']}{each['stopped'] and '; stopped: '}{each['stopped']}"
        )


if __name__ == "__main__":
    main()
