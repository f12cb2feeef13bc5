"""Comparison of all methods on two recordings: error, held-out prediction, time.

    python benchmarks/peers.py [--json] [--seed N]

`seconds`, `worst_relative_error` and `held_out_rms` are given by method for the default demo recording (4,000 samples
of two joints), and under `textbook` for the arm of configs/fake_two_link_ideal.toml. The worst relative error is taken
over inertias, gravity, viscous and Coulomb friction. The tuning of each peer is described in
estimator/baselines/compare.py and hil/estimation/comparison/mujoco_peer.py; mujoco.sysid is included if it is installed
(extra `peers`), with an initial guess within 50 % of the truth.

Times are medians of three runs of each method in one process, after one run for compilation, and exclude building the
model and residual of mujoco.sysid. On the demo recording, `hil` also fits the Stribeck friction and current lag of the
configuration, which takes additional time; `hil_coulomb` and mujoco.sysid are limited to Coulomb friction, so neither
can fit that arm completely. The textbook arm has Coulomb friction, as do all three models there, so the times are for
the same work. mujoco.sysid distributes its rollouts over all cores, and hil distributes two or three of its fits, so
the ratio is meaningful only on an idle machine.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.machine import machine
from hil.config.schema import load_config
from hil.estimation.comparison.compare import OURS, OURS_PLAIN, MethodResult, compare_run
from hil.experiment.run import run_experiment
from hil.runs.run_folder import RunFolder

CONFIGS = Path(__file__).parents[1] / "configs"
RECORDINGS = {"demo": "fake_two_link.toml", "textbook": "fake_two_link_ideal.toml"}
TIMES = 3  # runs of each method; the median time counts
KEYS = ("seconds", "worst_relative_error", "held_out_rms")


def measure(name: str, seed: int, mujoco: bool) -> dict[str, MethodResult]:
    config = load_config(CONFIGS / RECORDINGS[name])
    experiment = config.experiment.model_copy(update={"seed": seed})
    config = config.model_copy(update={"experiment": experiment})
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder.create(Path(folder) / "run", config)
        run_experiment(config, run, config.path, lambda _: None)
        compare_run(run, mujoco=False)  # compiles
        runs = [compare_run(run, mujoco).methods for _ in range(TIMES)]
    return {
        method: replace(found, seconds=statistics.median(each[method].seconds for each in runs))
        for method, found in runs[0].items()
    }


def installed() -> bool:
    try:
        from mujoco import sysid
    except ImportError:
        return False
    return hasattr(sysid, "optimize")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    found = {name: measure(name, options.seed, installed()) for name in RECORDINGS}
    if options.json:
        print(json.dumps({**_by_key(found["demo"]), "textbook": _by_key(found["textbook"])}))
        return
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}, seed {options.seed}")
    for name, methods in found.items():
        show(name, methods)


def _by_key(methods: dict[str, MethodResult]) -> dict[str, Any]:
    return {key: {name: getattr(entry, key) for name, entry in methods.items()} for key in KEYS}


def worst(found: MethodResult) -> float:
    """Relative error of the worst parameter; the true values are known, since all arms here are fake."""
    assert found.worst_relative_error is not None
    return found.worst_relative_error


def show(recording: str, methods: dict[str, MethodResult]) -> None:
    print(f"\n{recording:14s} {'seconds':>8s} {'worst error':>12s} {'of':12s} {'held out':>9s}  settings")
    for name, entry in methods.items():
        held_out = entry.held_out_rms
        shown = "-" if held_out is None else f"{100 * held_out:.3f} %"
        print(
            f"{name:14s} {entry.seconds:8.3f} {100 * worst(entry):10.3f} % "
            f"{entry.worst_parameter:12s} {shown:>9s}  {entry.settings}"
        )
    others = [worst(entry) for name, entry in methods.items() if name not in {OURS, OURS_PLAIN}]
    print(f"best of the others over ours: {min(others) / worst(methods[OURS]):.1f} in worst error")
    if "mujoco_sysid" in methods:
        seconds = {name: methods[name].seconds for name in (OURS, OURS_PLAIN, "mujoco_sysid")}
        ratios = (seconds["mujoco_sysid"] / seconds[name] for name in (OURS, OURS_PLAIN))
        print("mujoco.sysid over ours in time: {:.1f}, with Coulomb friction {:.1f}".format(*ratios))


if __name__ == "__main__":
    main()
