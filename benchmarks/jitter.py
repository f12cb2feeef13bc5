"""Effect of timing jitter on the estimate, with and without correction for the actual times, on the ideal fake arm.

    python benchmarks/jitter.py [--json] [--rms-us 0 200 500] [--config configs/fake_two_link_ideal.toml]

Each write happens at a random time after its deadline, drawn from a half-normal distribution with the given RMS. The
same recording is estimated twice: as it is, and with its times replaced by the deadlines.
"""

import argparse
import json
import math
import tempfile
from pathlib import Path

import numpy as np

from hil.config.schema import Config, load_config
from hil.drivers.rate import FixedRate, Tick
from hil.estimation.settled_estimate import estimate_run
from hil.experiment import stream
from hil.experiment.run import run_experiment
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

CONFIG = Path(__file__).parents[1] / "configs" / "fake_two_link_ideal.toml"


def late_rate(rms: float, seed: int = 1) -> type[FixedRate]:
    """A loop that wakes up late by `rms` [s]."""
    random = np.random.default_rng(seed)

    class LateRate(FixedRate):
        def wait(self) -> Tick:
            tick = super().wait()
            self._clock.wait_until(tick.now + rms * abs(random.standard_normal()))
            return Tick(tick.deadline, self._clock.now(), tick.missed)

    return LateRate


def forget_real_times(run: RunFolder, joints: int) -> None:
    samples = load_samples(run.samples_path, joints)
    samples["time_before_write"] = samples["deadline"]
    np.save(run.samples_path, samples, allow_pickle=False)


def figures(result: SettledResult) -> dict[str, float]:
    found, truth = result.parameters, result.truth
    assert truth is not None  # the arm is a fake one
    errors = {name: abs(found[name].value / true - 1.0) for name, true in truth.items() if true}
    worst = max((name for name in errors if not name.startswith("offset")), key=lambda name: errors[name])
    return {
        "worst_error": errors[worst],
        "residual_ticks": max(result.fit.residual_rms_ticks),
        "held_out_rms": max(result.validation.held_out_rms or [math.nan]),
    }


def measure(config: Config, rms: float) -> dict[str, dict[str, float]]:
    exact, stream.FixedRate = stream.FixedRate, late_rate(rms)  # type: ignore[misc]
    try:
        with tempfile.TemporaryDirectory() as folder:
            run = RunFolder.create(Path(folder) / "run", config)
            run_experiment(config, run, config.path, lambda _: None)
            real = figures(estimate_run(run))
            forget_real_times(run, len(config.joints))
            return {"real": real, "nominal": figures(estimate_run(run))}
    finally:
        stream.FixedRate = exact  # type: ignore[misc]


def main() -> None:
    from machine import machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rms-us", type=float, nargs="+", default=[0.0, 200.0, 500.0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    options = parser.parse_args()
    config = load_config(options.config)
    found = {f"{rms:g}": measure(config, 1e-6 * rms) for rms in options.rms_us}
    if options.json:
        print(json.dumps(found))
        return
    print(f"{machine()}; {options.config.stem} at {config.experiment.rate:g} Hz")
    for rms, both in found.items():
        for times, entry in both.items():
            print(
                f"late by {rms:>4s} us RMS, {times:7s} times: worst parameter {100 * entry['worst_error']:.3f} %, "
                f"residual {entry['residual_ticks']:.3f} steps, held out {100 * entry['held_out_rms']:.3f} %"
            )


if __name__ == "__main__":
    main()
