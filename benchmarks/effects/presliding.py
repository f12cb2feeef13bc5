"""Effect of the arm's presliding friction on the accuracy of models that include it and of models that do not.

    python benchmarks/effects/presliding.py [--json] [--seeds N] [--stiffness 1000 200 50 15 5] [--law slip]

The arm is the realistic fake arm without its bus. Its dry friction acts as a spring of this stiffness [N m/rad] before
it slides, with a damping ratio of 0.7. Both models include Stribeck friction. With `--law slip`, the arm follows a law
that the estimator does not have (benchmarks/effects/elastic_slip.py). The figures are the worst of N seeds; `gained` is
the smallest ratio of the held-out errors of the models without and with presliding.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

from benchmarks.effects.backlash import GROUPS
from benchmarks.effects.elastic_slip import SlippingMotor
from benchmarks.machine import machine
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError, PeriodicityError
from hil.estimator.identify import identify, predict
from hil.estimator.models.model import Model
from hil.fakes.plants.arm import Arm, base_parameters
from hil.fakes.plants.motor import Motor
from tests.support.recorded_arm import record, servo_arm, wave

FRICTION = {"current_lag": 1e-3, "stribeck_rise": 0.4, "stribeck_velocity": 0.15}
PEAK = (0.6, 0.35)  # N m
INERTIA = 0.012  # kg m^2, approximate inertia seen by either joint
LAWS: dict[str, type[Motor]] = {"bristles": Motor, "slip": SlippingMotor}


def figures(arm: Arm, period: SettledPeriod, held_out: SettledPeriod, presliding: bool) -> dict[str, float]:
    """Errors of one identification; all infinite if the fit or the prediction does not converge."""
    keys = (*(f"{group}_error" for group in GROUPS), "held_out_rms", "residual_ticks")
    try:
        found = identify(period, Model(2, "stribeck", "lag", ["presliding"] if presliding else []))
        predicted = predict(found, held_out.torque, held_out.rate, held_out.command_to_sample)
    except (ConvergenceError, PeriodicityError):
        return dict.fromkeys(keys, math.inf)
    truth = base_parameters(arm)
    errors = {name: abs(found.parameters[name] / true - 1.0) for name, true in truth.items()}
    worst = [max(error for name, error in errors.items() if name.split("_")[0] in kinds) for kinds in GROUPS.values()]
    held = float(relative_error(held_out.position, predicted).max())
    return dict(zip(keys, (*worst, held, float(found.residual_steps.max())), strict=True))


def measure(stiffness: float, seeds: int, law: type[Motor]) -> dict[str, dict[str, float]]:
    damping = 1.4 * math.sqrt(stiffness * INERTIA)
    arm = servo_arm({**FRICTION, "presliding_stiffness": stiffness, "presliding_damping": damping})
    runs: dict[str, list[dict[str, float]]] = {"without": [], "with": []}
    for seed in range(seeds):
        with patch("hil.fakes.plants.two_link.Motor", law):
            period, held_out = (record(arm, wave(2 * seed + each, PEAK)).rounded() for each in (1, 2))
        for name, entries in runs.items():
            entries.append(figures(arm, period, held_out, name == "with"))
    worst = {name: {key: max(run[key] for run in each) for key in each[0]} for name, each in runs.items()}
    pairs = zip(runs["without"], runs["with"], strict=True)
    worst["with"]["gained"] = float(np.min([a["held_out_rms"] / b["held_out_rms"] for a, b in pairs]))
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--stiffness", type=float, nargs="+", default=[1000.0, 200.0, 50.0, 15.0, 5.0])
    parser.add_argument("--law", choices=LAWS, default="bristles")
    options = parser.parse_args()
    law = LAWS[options.law]
    found = {f"{stiffness:g}": measure(stiffness, options.seeds, law) for stiffness in options.stiffness}
    if options.json:
        print(json.dumps(found))
        return
    print(f"{machine()}; the arm has {options.law}, worst of {options.seeds} seeds")
    for stiffness, entry in found.items():
        for name, each in entry.items():
            shown = (
                f"{k} {v:.2f}" if k in ("gained", "residual_ticks") else f"{k} {100 * v:.3f} %" for k, v in each.items()
            )
            print(f"{stiffness:>5s} N m/rad {name:7s} {', '.join(shown)}")


if __name__ == "__main__":
    main()
