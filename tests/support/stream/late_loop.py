"""Experiments with a loop that wakes up late, with and without correction; shared with benchmarks/effects/jitter.py."""

import math
import tempfile
from pathlib import Path

import numpy as np

from hil.config.schema import Config
from hil.drivers.rate import FixedRate, Tick
from hil.estimation.settled_estimate import estimate_run
from hil.experiment import pace
from hil.experiment.run import run_experiment
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder


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
    """Replace the recorded times of the writes by the nominal ones."""
    samples = load_samples(run.samples_path, joints)
    samples["time_before_write"] = samples["deadline"]
    np.save(run.samples_path, samples, allow_pickle=False)


def figures(result: SettledResult) -> dict[str, float]:
    """Worst relative error of a base parameter, RMS of the residuals [ticks], and held-out RMS of the estimate."""
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
    """Figures of the estimates from the real and from the nominal times, with a loop that is late by `rms` [s]."""
    exact, pace.FixedRate = pace.FixedRate, late_rate(rms)  # type: ignore[misc]
    try:
        with tempfile.TemporaryDirectory() as folder:
            run = RunFolder.create(Path(folder) / "run", config)
            run_experiment(config, run, config.path, lambda _: None)
            real = figures(estimate_run(run))
            forget_real_times(run, len(config.joints))
            return {"real": real, "nominal": figures(estimate_run(run))}
    finally:
        pace.FixedRate = exact  # type: ignore[misc]
