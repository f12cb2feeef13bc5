"""Computing time between two exchanges, especially at the end of a period.

    python benchmarks/period_gap.py [--json] [--rate HZ] [--period S]

The stream runs for two periods at 1 kHz, including guard, model, recorder and comparison of periods, on a substitute
for the bus that answers immediately. The measured time is the processor time of the stream's thread from the end of an
exchange to the beginning of the next; it excludes other programs but would include any work on a complete period. The
output gives the longest time, the longest time at the ends of periods, and by how much the latter exceeds the interval
minus the wire time of an exchange. Because stalls of a virtual machine count as processor time too, the longest
iteration of a counting loop with the same median time and number of iterations is printed for comparison.
"""

import argparse
import gc
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.machine import machine
from hil.config.schema import Config, load_config
from hil.drivers.state import State
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Stream
from hil.fakes.bus.clock import VirtualClock
from hil.plan.plan import Plan, Segment, rest_window
from hil.runs.recording import Recorder

CONFIG = Path(__file__).parents[1] / "configs" / "fake_two_link.toml"
EXCHANGE_S = 0.39e-3
"""Duration of an exchange with two servos at 2 Mbaud [s], the lowest baud rate at which 1 kHz is comfortable."""


class StandIn:
    """A substitute for the bus. Its joints are deflected in proportion to their current."""

    def __init__(self, config: Config, clock: VirtualClock, swing: float) -> None:
        self.joints = config.bus.joints
        self.port = self.prepared = self
        self.exchanges_per_sample = 1
        self.patience = 0.02
        self.read_back_at, self.awaited_until = math.inf, -math.inf
        self.clock = clock
        self.spent: list[int] = []
        """Processor time before each exchange [ns]."""
        self._swing = swing
        self._former: tuple[float, ...] = (0.0,) * len(self.joints)
        self._left_at = 0
        self._rest = self._position = tuple(config.arm.rest_pose)

    def read_torque(self) -> None:
        """Torque stays on."""

    def exchange(self, goals: list[float]) -> State:
        self.spent.append(time.thread_time_ns() - self._left_at)
        now = self.clock.now()
        # The motion lags by half an interval. Over whole waves, the motors then do no work, so the guard does not stop.
        position = tuple(
            rest + 0.5 * self._swing * (goal + former)
            for rest, goal, former in zip(self._rest, goals, self._former, strict=True)
        )
        interval = 1e-3
        velocity = tuple((new - old) / interval for new, old in zip(position, self._position, strict=True))
        self._position = position
        self._former = tuple(goals)
        nothing = (0,) * len(goals)
        state = State(
            now, now + EXCHANGE_S, tuple(goals), tuple(goals), velocity, position, nothing, (False,) * len(goals)
        )
        self._left_at = time.thread_time_ns()
        return state


def measure(rate: float, period: float) -> dict[str, Any]:
    """Run the measurement; return its figures [ms]."""
    config = load_config(CONFIG)
    config = config.model_copy(
        update={"experiment": config.experiment.model_copy(update={"rate": rate, "period": period, "held_out": False})}
    )
    samples = round(rate * period)
    when = np.arange(samples) / rate
    wave = np.stack([0.2 * np.sin(math.tau * when), 0.1 * np.sin(math.tau * 2 * when)], axis=1)
    plan = Plan(
        rate=rate,
        segments=(Segment("identify", None, wave, round(rate)),),  # type: ignore[arg-type]
        rest_samples=200,
        end_samples=rest_window(rate),
        brake_samples=20,
        max_settling_periods=5,
        periods=1,
        settle_within=0.01,
        drift_within=0.2,
    )
    clock = VirtualClock()
    bus = StandIn(config, clock, 0.05)
    with tempfile.TemporaryDirectory() as folder, Recorder(Path(folder) / "samples.npy", 2, plan.capacity) as recorder:
        stream = Stream(bus, plan, config, recorder, StopRequest(), lambda _: None, lambda _: None)  # type: ignore[arg-type]
        # The substitute does not obey the laws of mechanics. The model checks every sample, but its verdict is ignored.
        assert stream._model is not None
        stream._model._raise = lambda *_: None  # type: ignore[method-assign]
        gc.collect()
        gc.disable()
        try:
            stream.run()
        finally:
            gc.enable()
    spent = 1e-6 * np.array(bus.spent[1:])
    first = plan.rest_samples + plan.segments[0].ramp_samples
    ends = [first + samples * number - 1 for number in range(3)]
    at_ends = max(float(spent[end - 2 : end + 3].max()) for end in ends)
    longest = float(spent.max())
    return {
        "rate": rate,
        "period_s": period,
        "exchanges": len(bus.spent),
        "median_ms": round(float(np.median(spent)), 4),
        "p99_9_ms": round(float(np.quantile(spent, 0.999)), 4),
        "longest_ms": round(longest, 4),
        "longest_at_period_ends_ms": round(at_ends, 4),
        "beyond_interval_ms": round(max(0.0, at_ends - (1e3 / rate - 1e3 * EXCHANGE_S)), 4),
        "machine_longest_ms": round(_machine_longest(len(spent), float(np.median(spent))), 4),
    }


def _machine_longest(turns: int, median_ms: float) -> float:
    """Longest of `turns` runs of a counting loop that takes about `median_ms` [ms of processor time]."""
    counts = 100
    while True:
        started = time.thread_time_ns()
        _count(counts)
        if 1e-6 * (time.thread_time_ns() - started) >= median_ms:
            break
        counts = round(1.3 * counts)
    longest = 0
    for _ in range(turns):
        started = time.thread_time_ns()
        _count(counts)
        longest = max(longest, time.thread_time_ns() - started)
    return 1e-6 * longest


def _count(until: int) -> None:
    for _ in range(until):
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--period", type=float, default=400.0)
    options = parser.parse_args()
    measured = measure(options.rate, options.period)
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:28s} {value}")


if __name__ == "__main__":
    main()
