"""Accuracy of `hil identify` on fake arms: parameter errors, residual, held-out prediction, and computing time.

    python benchmarks/identify.py [--json] [--seeds N]

Each arm is identified with N seeds (different phases of the multisine). The output gives the worst seed, and the number
of further seeds that the guard stopped because their phases swing the arm beyond a limit. `demo_seconds` is the time of
`hil identify configs/fake_two_link.toml` in a new process with an empty numba cache.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.machine import machine
from hil.config.schema import Config, load_config
from hil.errors import SafetyStop
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.results.result import SettledResult
from hil.runs.run_folder import RunFolder

CONFIGS = Path(__file__).parents[1] / "configs"
GROUPS = {
    "inertia": ("inertia_1", "coupling", "inertia_2", "armature_2"),
    "gravity": ("gravity_1", "gravity_2"),
    "friction": ("viscous_1", "viscous_2", "coulomb_1", "coulomb_2"),
}


def identify(config: Config) -> SettledResult:
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder.create(Path(folder) / "run", config)
        run_experiment(config, run, config.path, lambda _: None)
        return estimate_run(run)


def figures(result: SettledResult) -> dict[str, float]:
    found, truth = result.parameters, result.truth
    assert truth is not None  # the arm is a fake one
    worst = {
        f"{group}_error": max(abs(found[name].value / truth[name] - 1) for name in names)
        for group, names in GROUPS.items()
    }
    offsets = max(abs(found[n].value - truth[n]) / found[n].std for n in ("offset_1", "offset_2"))
    return {
        **worst,
        "offset_error_in_std": offsets,
        "residual_ticks": max(result.fit.residual_rms_ticks),
        "held_out_rms": max(result.validation.held_out_rms or [math.nan]),
        "estimation_seconds": result.timing.estimation_seconds,
    }


def worst_of_seeds(name: str, seeds: int) -> dict[str, float]:
    """The worst figures of N seeds, not counting those that the guard stops at a position limit."""
    config = load_config(CONFIGS / f"{name}.toml")
    runs: list[dict[str, float]] = []
    stopped = 0
    while len(runs) < seeds:
        experiment = config.experiment.model_copy(update={"seed": 1 + len(runs) + stopped})
        try:
            runs.append(figures(identify(config.model_copy(update={"experiment": experiment}))))
        except SafetyStop:
            stopped += 1
    return {**{key: max(run[key] for run in runs) for key in runs[0]}, "seeds_stopped_by_guard": stopped}


def seconds_of(*command: str) -> float:
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "hil", *command],
            check=True,
            capture_output=True,
            cwd=folder,
            env={**os.environ, "NUMBA_CACHE_DIR": folder},
        )
        return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    measured: dict[str, Any] = {
        name: worst_of_seeds(name, options.seeds) for name in ("fake_two_link_ideal", "fake_two_link")
    }
    measured["demo_seconds"] = seconds_of("identify", str(CONFIGS / "fake_two_link.toml"))
    measured["help_seconds"] = min(seconds_of("--help") for _ in range(5))
    if options.json:
        print(json.dumps(measured))
        return
    print(f"{machine()}; worst of {options.seeds} seeds")
    for name in ("fake_two_link_ideal", "fake_two_link"):
        print(name)
        for key, value in measured[name].items():
            shown = f"{100 * value:.3f} %" if key.endswith(("_error", "_rms")) else f"{value:.3f}"
            print(f"  {key:22s} {shown}")
    print(f"demo, cold {measured['demo_seconds']:.1f} s; hil --help {measured['help_seconds']:.2f} s")


if __name__ == "__main__":
    main()
