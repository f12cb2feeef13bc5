"""Lateness of hil's fixed-rate loop, compared with a loop that calls `time.sleep(dt)`.

    python benchmarks/fixed_rate.py                  10 s of each loop at 500 Hz and at 1 kHz
    python benchmarks/fixed_rate.py --seconds 60 --json

Lateness is the time from a deadline to the moment at which its work can begin. Drift is the lateness of the last
deadlines of a run minus that of the first ones. The top level of the JSON object holds the worst values of hil's loop
over both rates. In addition, this loop is stalled deliberately for ten and a half periods; it must then count nine
missed deadlines.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.machine import machine
from hil.drivers.clock import WallClock
from hil.drivers.rate import FixedRate
from hil.setup.realtime import real_time

STALL_PERIODS = 10.5
STALL_MISSES = 9

Lateness = NDArray[np.float64]


def sleep_dt(rate: float, count: int) -> tuple[Lateness, int]:
    """The usual control loop: work, then `time.sleep(dt - elapsed)`."""
    interval = 1 / rate
    late = np.empty(count)
    start = time.perf_counter() + interval
    time.sleep(interval)
    for index in range(count):
        began = time.perf_counter()
        late[index] = began - (start + index * interval)
        time.sleep(max(0.0, interval - (time.perf_counter() - began)))
    # In a drifting loop, a deadline counts as missed if the lateness grew by at least one interval since the last one.
    return late, int((np.diff(late) >= interval).sum())


def absolute_sleep(rate: float, count: int) -> tuple[Lateness, int]:
    """Absolute deadlines, with a plain sleep until each of them."""
    interval = 1 / rate
    late = np.empty(count)
    start = time.perf_counter() + interval
    for index in range(count):
        deadline = start + index * interval
        time.sleep(max(0.0, deadline - time.perf_counter()))
        late[index] = time.perf_counter() - deadline
    return late, int((late >= interval).sum())


def ours(rate: float, count: int) -> tuple[Lateness, int]:
    """The driver's FixedRate with the real-time settings that the system permits."""
    late = np.empty(count)
    with real_time():
        ticks = FixedRate(WallClock(), rate)
        for index in range(count):
            deadline, now, _ = ticks.wait()
            late[index] = now - deadline
    return late, ticks.missed


def ours_ordinary(rate: float, count: int) -> tuple[Lateness, int]:
    """The driver's FixedRate in an ordinary process."""
    late = np.empty(count)
    ticks = FixedRate(WallClock(), rate)
    for index in range(count):
        deadline, now, _ = ticks.wait()
        late[index] = now - deadline
    return late, ticks.missed


LOOPS: dict[str, Callable[[float, int], tuple[Lateness, int]]] = {
    "time.sleep(dt)": sleep_dt,
    "absolute, sleeping": absolute_sleep,
    "ours, ordinary": ours_ordinary,
    "ours": ours,
}


def figures(late: Lateness, missed: int) -> dict[str, Any]:
    tenth = max(1, len(late) // 10)
    p50, p99, p999 = np.quantile(late, [0.5, 0.99, 0.999]) * 1e6
    return {
        "lateness_p50_us": round(float(p50), 2),
        "lateness_p99_us": round(float(p99), 2),
        "lateness_p99_9_us": round(float(p999), 2),
        "lateness_max_us": round(float(late.max()) * 1e6, 1),
        "drift_us": round(float(np.median(late[-tenth:]) - np.median(late[:tenth])) * 1e6, 2),
        "missed": missed,
    }


def stalled(rate: float) -> int:
    """Number of deadlines counted as missed when the work at one of them takes ten and a half periods."""
    ticks = FixedRate(WallClock(), rate)
    for index in range(100):
        deadline = ticks.wait().deadline
        if index == 50:
            end = deadline + STALL_PERIODS / rate
            while time.perf_counter() < end:
                pass
    return ticks.missed


def show(result: dict[str, Any]) -> None:
    print(f"{result['seconds']:g} s of each loop. {result['machine']}.")
    print("Real time: " + "; ".join(result["real_time"]) + "\n")
    for rate, loops in result["rates"].items():
        print(
            f"{rate + ' Hz':<22}{'p50 us':>10}{'p99 us':>10}{'p99.9 us':>10}{'max us':>10}{'drift us':>12}{'missed':>8}"
        )
        for name, each in loops.items():
            numbers = [each[f"lateness_{key}_us"] for key in ("p50", "p99", "p99_9", "max")]
            print(f"  {name:<20}" + "".join(f"{n:>10.1f}" for n in numbers), end="")
            print(f"{each['drift_us']:>12.1f}{each['missed']:>8}")
    counted = result["stall"]["counted"]
    print(f"\nA stall of {STALL_PERIODS} periods: {counted} counted as missed, {STALL_MISSES} expected.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each loop at each rate")
    parser.add_argument("--rates", type=float, nargs="+", default=[500.0, 1000.0], metavar="HZ")
    options = parser.parse_args()
    with real_time() as granted:
        permitted = [str(each) for each in granted]
    rates = {
        f"{rate:g}": {name: figures(*loop(rate, round(rate * options.seconds))) for name, loop in LOOPS.items()}
        for rate in options.rates
    }
    worst = {
        key: max((loops["ours"][key] for loops in rates.values()), key=abs)
        for key in ("lateness_p50_us", "lateness_p99_us", "drift_us", "missed")
    }
    with real_time():  # on a busy machine, an ordinary process misses deadlines of its own
        stall = {"periods": STALL_PERIODS, "expected": STALL_MISSES, "counted": stalled(500.0)}
    result = {
        **worst,
        "rates": rates,
        "stall": stall,
        "seconds": options.seconds,
        "real_time": permitted,
        "machine": machine(),
    }
    print(json.dumps(result)) if options.json else show(result)


if __name__ == "__main__":
    main()
