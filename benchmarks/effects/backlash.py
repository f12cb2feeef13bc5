"""Effect of gear backlash on an estimator that does not model it, on the realistic fake arm.

    python benchmarks/effects/backlash.py [--json] [--play 0 0.0005 0.0015 0.004] [--presliding]

The play [rad] is measured from flank to flank and applies to both joints, between the rotor and the output shaft, which
carries the encoder. --presliding adds presliding friction to the model, which might mimic play.
"""

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from hil.config.schema import load_config
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.results.result import SettledResult
from hil.runs.run_folder import RunFolder

CONFIG = Path(__file__).parents[2] / "configs" / "fake_two_link.toml"
GROUPS = {"inertia": ("inertia", "coupling", "armature"), "gravity": ("gravity",), "friction": ("viscous", "coulomb")}


def measure(play: float, presliding: bool) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.toml"
        drives = "[[fake.arm.drives]]\n"
        text = CONFIG.read_text(encoding="utf-8")
        if presliding:
            text = text.replace("[model]\n", "[model]\npresliding = true\n")
        path.write_text(text.replace(drives, f"{drives}backlash = {play}\n") if play else text, encoding="utf-8")
        config = load_config(path)
        run = RunFolder.create(Path(folder) / "run", config)
        run_experiment(config, run, config.path, lambda _: None)
        result = estimate_run(run)
    return figures(result)


def figures(result: SettledResult) -> dict[str, float]:
    found, truth = result.parameters, result.truth
    assert truth is not None  # the arm is a fake one
    errors = {name: abs(found[name].value / true - 1.0) for name, true in truth.items() if true}
    worst = {
        f"{group}_error": max(error for name, error in errors.items() if name.split("_")[0] in kinds)
        for group, kinds in GROUPS.items()
    }
    over = {"residual_over_floor": max(result.validation.residual_over_floor or [math.nan])}
    return {**worst, **over, "held_out_rms": max(result.validation.held_out_rms or [math.nan])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--play", type=float, nargs="+", default=[0.0, 0.0005, 0.0015, 0.004])
    parser.add_argument("--presliding", action="store_true")
    options = parser.parse_args()
    found = {f"{play:g}": measure(play, options.presliding) for play in options.play}
    if options.json:
        print(json.dumps(found))
        return
    print(machine())
    for play, entry in found.items():
        shown = ", ".join(f"{name} {100 * value:.2f} %" for name, value in entry.items() if "floor" not in name)
        print(f"play {play:>6s} rad: {shown}, residual {entry['residual_over_floor']:.1f} times the noise")


if __name__ == "__main__":
    main()
