"""Computing time and memory of both estimation stages for periods of increasing length.

    python benchmarks/growth.py [--json] [--most N]

Each measurement uses one settled period of the ideal arm, with 4,000 to 1,000,000 samples at 400 Hz but always the same
number of excited frequencies, and runs in a separate process. The motion comes from the estimator's own simulation,
rounded to encoder steps, since only time and memory are measured, not accuracy.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.machine import machine
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import design_multisine
from hil.estimator.fit.stage1 import fit_lines
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.drive import motor_torque
from hil.fakes.plants.arm import base_parameters
from tests.support.recorded_arm import COMMAND_TO_SAMPLE, RATE, STEP, servo_arm

SIZES = (4_000, 16_000, 62_500, 250_000, 1_000_000)
LINES = 25  # per joint
PEAK = (0.50, 0.30)  # N m; never beyond the upright pose, where a long motion would be chaotic


def period_of(samples: int) -> SettledPeriod:
    """Return a period of any length with LINES excited frequencies per joint, all below 5 Hz."""
    period = samples / RATE
    # Random lines: evenly spaced ones have a common factor and would repeat one short period, including rounding.
    drawn = np.random.default_rng(1).choice(np.arange(1, round(5.0 * period)), 2 * LINES - 1, replace=False)
    lines = [sorted(drawn[:LINES].tolist()), sorted(drawn[LINES:].tolist())]
    wave = design_multisine(RATE, period, lines, PEAK, 2)
    truth = base_parameters(servo_arm({"coulomb_width": 0.05}))
    physics = Physics.of({**truth, "coulomb_width_1": 0.05, "coulomb_width_2": 0.05})
    steps = steps_per_sample(RATE)
    torque = motor_torque(wave.torque, RATE, COMMAND_TO_SAMPLE, steps, delay=0.0, lag=0.0)
    state = np.array([[-np.pi / 2, 0.0], [0.0, 0.0]])
    _, state = simulate(physics, state, torque[:, -40 * int(RATE) :], 1.0 / (RATE * steps))
    position, _ = simulate(physics, state, torque, 1.0 / (RATE * steps))
    return SettledPeriod(RATE, wave.torque, np.round(position / STEP) * STEP, COMMAND_TO_SAMPLE, np.full(2, STEP))


def measure(samples: int) -> dict[str, float]:
    identify(period_of(4_000), Model(2))  # compiles
    period = period_of(samples)
    seconds = []
    for _ in range(5 if samples <= 16_000 else 1):
        started = time.perf_counter()
        fit_lines(period)
        seconds.append(time.perf_counter() - started)
    started = time.perf_counter()
    estimate = identify(period, Model(2))
    both = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    evaluations = estimate.iterations
    return {"samples": samples, "stage_1": min(seconds), "both": both, "evaluations": evaluations, "peak_gib": peak}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--most", type=int, default=SIZES[-1])
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one)))
        return
    measured = []
    for samples in (size for size in SIZES if size <= options.most):
        command = [sys.executable, __file__, "--one", str(samples)]
        measured.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    print("  samples   stage 1 [s]   both [s]   evaluations   both per evaluation and sample [us]   peak [GiB]")
    for row in measured:
        each = 1e6 * row["both"] / row["samples"] / row["evaluations"]
        print(
            f"{row['samples']:9,d} {row['stage_1']:13.4f} {row['both']:10.2f} {row['evaluations']:13d} {each:37.2f} "
            f"{row['peak_gib']:12.2f}"
        )


if __name__ == "__main__":
    main()
