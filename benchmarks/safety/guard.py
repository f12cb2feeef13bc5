"""Computing time of the guard per sample, for two joints: `clamp` before and `look` after the exchange.

    python benchmarks/safety/guard.py [--json]

The samples of a run of the fake arm are repeatedly passed to the guard, without bus and recorder. For each round, the
mean over its samples is taken; the output gives the median of these means, and also the smallest one, because other
programs can only add to the time.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from hil.config.schema import Config
from hil.drivers.state import State
from hil.experiment.guard import Guard
from hil.experiment.run import run_experiment
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.short_experiment import CONFIG, short_config

ROUNDS = 200


def guard_cost(rounds: int = ROUNDS) -> list[float]:
    """Mean time per sample [s] of each round."""
    config = short_config(CONFIG.read_text(encoding="utf-8"))
    states = recorded_states(config)
    costs = []
    for _ in range(rounds):
        guard = Guard(config)
        started = time.perf_counter()
        for state in states:
            guard.clamp(state.goal_current)
            guard.look(state, 0.005)
        costs.append((time.perf_counter() - started) / len(states))
    return costs


def recorded_states(config: Config) -> list[State]:
    """The samples of an undisturbed run in motion, as the stream received them, without the slow reads."""
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder.create(Path(folder) / "run", config)
        run_experiment(config, run, CONFIG, lambda _: None)
        samples = load_samples(run.samples_path, len(config.joints))
    names = ("goal_current", "current", "velocity", "position", "error", "missing")
    return [
        State(
            float(row["time_before_write"]),
            float(row["time_after_read"]),
            **{name: tuple(row[name].tolist()) for name in names},  # type: ignore[arg-type]
        )
        for row in samples[samples["phase"] == Phase.PERIODIC]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    costs = guard_cost()
    measured = {"joints": 2, "us_a_sample": round(1e6 * median(costs), 2), "us_fastest": round(1e6 * min(costs), 2)}
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:12s} {value}")


if __name__ == "__main__":
    main()
