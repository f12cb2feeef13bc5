"""Run an experiment with faults; report whether it was stopped, why, after what delay, and how far the arm overshot its
limits.
"""

from pathlib import Path
from typing import Any

import numpy as np

from hil.config.schema import Config, load_config
from hil.drivers.errors import DriverError, TorqueNotOff
from hil.errors import ExperimentError, SafetyStop
from hil.experiment.run import run_experiment
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder


def inject(arm: Path, folder: Path) -> dict[str, Any]:
    """Run the experiment of `arm`, during which its [[fake.faults]] occur.

    Returns:
        `fault.outcome`: "finished", "stopped" (by the guard), or "failed" (ended by the experiment or the bus); `cause`
        and `message`, as reported; `torque_off_confirmed`, whether all servos confirmed that their torque is off;
        `samples`, the number of samples; `stopped_after_s`, the time from the first fault to the last sample on the
        arm's clock; `beyond_limit_rad`, the farthest that a joint moved beyond its limits.
    """
    config = load_config(arm)
    run = RunFolder.create(folder, config)
    outcome, cause, message, off = "finished", "", "", True
    try:
        run_experiment(config, run, config.path, lambda _: None)
    except (ExperimentError, DriverError) as error:
        seen = _first_stop(error)
        outcome = "failed" if seen is None else "stopped"
        cause = type(error).__name__ if seen is None else seen.cause.value
        message, off = str(seen or error), not isinstance(error, TorqueNotOff)
    return {
        "fault": {
            "outcome": outcome,
            "cause": cause,
            "message": message,
            "torque_off_confirmed": off,
            **_seen(config, run.samples_path),
        }
    }


def _first_stop(error: BaseException | None) -> SafetyStop | None:
    """What the guard detected, even if the bus failed afterwards."""
    while error is not None and not isinstance(error, SafetyStop):
        error = error.__cause__ or error.__context__
    return error


def _seen(config: Config, path: Path) -> dict[str, Any]:
    samples = load_samples(path, len(config.joints)) if path.exists() else None
    if samples is None or not len(samples):
        return {"samples": 0, "stopped_after_s": None, "beyond_limit_rad": 0.0}
    faults = () if config.fake is None else config.fake.faults
    began = min((fault.at for fault in faults), default=None)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    position = samples["position"]
    beyond = np.nanmax(np.maximum(low - position, position - high), initial=0.0)
    end = float(samples["time_before_write"][-1])
    return {
        "samples": len(samples),
        "stopped_after_s": None if began is None else end - began,
        "beyond_limit_rad": float(beyond),
    }
