"""Errors of many identifications relative to the Cramer-Rao bound, and coverage of the confidence intervals.

    python benchmarks/monte_carlo.py [--json] [--seeds N]

The recording is one settled period of 10 s at 400 Hz with peak torques of 0.80 and 0.42 N m. The arm is the ideal fake
arm with smooth Coulomb and viscous friction; its equations use masses and lengths and are independent of the
estimator's. Each seed draws new position errors: normal errors of half an encoder step, then rounding to steps with a
random zero. The bound assumes white errors with the variance of both together. The seeds cycle through WAVES
multisines. `rounding_only` gives the same figures without the normal errors, as for a good encoder; its rounding errors
are not white where a joint moves slowly.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.machine import machine
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.fakes.plants.arm import base_parameters
from hil.study.jobs import each
from tests.support.recorded_arm import Recorded, record, servo_arm, wave

WAVES = 10
NOISE = 0.5  # encoder steps
WIDTH = 0.05  # rad/s
MODEL = Model(2, "coulomb", "delay")


def bound(recorded: Recorded, truth: dict[str, float], variance: float) -> np.ndarray:
    """Cramer-Rao bound: smallest standard deviation (parameters,) of an unbiased estimate from these positions."""
    period = recorded.period(recorded.position)
    names = MODEL.names
    run = SimulatedRun.of(period, IntegrationOptions())
    information = np.zeros((len(names) + 4,) * 2)
    for _, _, derivative in run.pieces(Physics.of(truth), recorded.start, names):
        J = derivative.reshape(-1, derivative.shape[2])
        information += J.T @ J
    size = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(size, size))
    return np.sqrt(variance * np.diag(inverse)[: len(names)]) / size[: len(names)]


def campaign(
    recordings: list[Recorded], truth: dict[str, float], noise: float, seeds: int, jobs: int | None = None
) -> dict[str, Any]:
    step = recordings[0].step
    variance = step**2 * (noise**2 + 1.0 / 12.0)
    bounds = [bound(recorded, truth, variance) for recorded in recordings]
    true = np.array([truth[name] for name in MODEL.base_names])
    items = [(recordings[seed % len(recordings)], noise, seed) for seed in range(seeds)]
    value, std = zip(*each(_identified, items, count=jobs), strict=True)
    least = [bounds[seed % len(recordings)][:12] for seed in range(seeds)]
    return _figures(np.array(value) - true, np.array(std), np.array(least))


def _identified(item: tuple[Recorded, float, int]) -> tuple[np.ndarray, np.ndarray]:
    """Values and standard deviations of the base parameters of one seed's recording."""
    recorded, noise, seed = item
    estimate = identify(noisy(recorded, noise, np.random.default_rng(seed)), MODEL)
    return estimate.value[:12], estimate.std[:12]


def noisy(recorded: Recorded, noise: float, random: np.random.Generator) -> SettledPeriod:
    step = recorded.step
    position = recorded.position + noise * step * random.standard_normal(recorded.position.shape)
    zero = step * random.uniform(-0.5, 0.5, (2, 1))
    rounded = np.round((position + zero) / step) * step - zero
    return recorded.period(rounded)


def _figures(error: np.ndarray, std: np.ndarray, least: np.ndarray) -> dict[str, Any]:
    named = {
        "rmse_over_crlb": np.sqrt(np.mean((error / least) ** 2, axis=0)),
        "bias_in_std": np.mean(error / least, axis=0),
        "coverage_95": np.mean(np.abs(error) < 1.959964 * std, axis=0),
    }
    return {key: dict(zip(MODEL.base_names, value.tolist(), strict=True)) for key, value in named.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--jobs", type=int, help="workers; one per core unless given")
    options = parser.parse_args()
    arm = servo_arm({"coulomb_width": WIDTH})
    recordings = [record(arm, wave(seed, (0.80, 0.42))) for seed in range(1, min(WAVES, options.seeds) + 1)]
    truth = {**base_parameters(arm), "coulomb_width_1": WIDTH, "coulomb_width_2": WIDTH, "delay": 0.0}
    measured = campaign(recordings, truth, NOISE, options.seeds, options.jobs)
    measured["rounding_only"] = campaign(recordings, truth, 0.0, options.seeds, options.jobs)
    measured["seeds"] = options.seeds
    if options.json:
        print(json.dumps(measured))
        return
    print(f"{machine()}; {options.seeds} seeds; noise {NOISE} encoder steps and rounding | rounding only")
    print(f"{'':12s}" + 2 * "  RMSE/bound  bias/bound  coverage |")
    for name in MODEL.base_names:
        shown = [
            f"  {part['rmse_over_crlb'][name]:10.3f}  {part['bias_in_std'][name]:+10.3f}  "
            f"{100 * part['coverage_95'][name]:6.1f} % |"
            for part in (measured, measured["rounding_only"])
        ]
        print(f"{name:12s}" + "".join(shown))
    for part in (measured, measured["rounding_only"]):
        ratios = list(part["rmse_over_crlb"].values())
        print(f"RMSE/bound: mean {math.fsum(ratios) / 12:.3f}, worst {max(ratios):.3f}")


if __name__ == "__main__":
    main()
