"""Automatic choice of the friction model on realistic arms: Stribeck, load dependence, current lag, and more effects.

    python benchmarks/friction_models.py [--json] [--seeds N]

The arm is that of configs/fake_two_link.toml, with dry friction that grows by 5 % of the motor's torque; `ripple` adds
2 % of torque ripple over the angle, and `presliding` adds presliding friction of about 3 mrad. The model is chosen by
hil (`friction = "auto"`). The figures are the worst of N seeds; seeds for which the guard stops the arm are counted and
skipped.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.identify import figures, identify
from benchmarks.machine import machine
from hil.config.schema import parse_config
from hil.errors import SafetyStop

SOURCE = Path(__file__).parents[1] / "configs" / "fake_two_link.toml"
LAG = "current_lag = 1.0e-3"
ARMS = {
    "load": "load = 0.05\n",
    "ripple": "load = 0.05\nripple = 0.02\n",
    "presliding": "load = 0.05\npresliding_stiffness = 20.0\npresliding_damping = 0.4\n",
}


def arm_text(name: str) -> str:
    text = SOURCE.read_text(encoding="utf-8")
    for old, new in ((LAG, ARMS[name] + LAG), ('friction = "stribeck"', 'friction = "auto"')):
        assert old in text, old
        text = text.replace(old, new)
    return text


def worst_of_seeds(name: str, seeds: int) -> dict[str, Any]:
    runs: list[dict[str, float]] = []
    chosen: Counter[str] = Counter()
    stopped = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.toml"
        path.write_text(arm_text(name), encoding="utf-8")
        config = parse_config(path.read_text(encoding="utf-8"), path)
        while len(runs) < seeds:
            experiment = config.experiment.model_copy(update={"seed": 1 + len(runs) + stopped})
            try:
                result = identify(config.model_copy(update={"experiment": experiment}))
            except SafetyStop:
                stopped += 1
                continue
            runs.append(figures(result))
            if result.model_choice is not None:
                chosen[result.model_choice.chosen] += 1
    worst = {key: max(run[key] for run in runs) for key in runs[0]}
    return {**worst, "seeds_stopped_by_guard": stopped, "chosen": dict(chosen)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    measured = {name: worst_of_seeds(name, options.seeds) for name in ARMS}
    if options.json:
        print(json.dumps(measured))
        return
    print(f"{machine()}; worst of {options.seeds} seeds")
    for name, each in measured.items():
        print(f"{name}, chosen: {', '.join(f'{model} {times}' for model, times in each.pop('chosen').items())}")
        for key, value in each.items():
            print(f"  {key:22s} " + (f"{100 * value:.3f} %" if key.endswith(("_error", "_rms")) else f"{value:.3f}"))


if __name__ == "__main__":
    main()
