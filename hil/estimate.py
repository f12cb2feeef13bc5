"""From a run folder to its result: settled period, both stages, the check on a multisine that was not used."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.identify import Estimate, identify, predict
from estimator.model import Model
from hil.config import Config
from hil.plan import HELD_OUT, IDENTIFY
from hil.recording import load_samples
from hil.result import make_result
from hil.run_folder import RunFacts, RunFolder
from hil.settled import settled_period
from hil.timing import timing


def estimate_run(run: RunFolder) -> dict[str, Any]:
    """Estimate from the recording in `run` and write its result.json; the result. Raises HilError, EstimationError."""
    config, facts = run.load_config(), run.load_facts()
    samples = load_samples(run.samples_path, len(config.joints))
    started = time.perf_counter()
    period = settled_period(config, facts, samples, IDENTIFY)
    model = Model(len(config.joints), config.model.friction, config.model.drive)
    estimate = identify(period, model)
    held_out = _held_out(config, facts, samples, estimate) if HELD_OUT in facts.segments else None
    seconds = round(time.perf_counter() - started, 3)
    kept_time = {**timing(samples, config.experiment.rate), "estimation_seconds": seconds}
    result = make_result(config, facts.config, period, estimate, held_out, kept_time)
    run.write_result(result)
    return result


def _held_out(config: Config, facts: RunFacts, samples: NDArray[np.void], estimate: Estimate) -> NDArray[np.float64]:
    """RMS of measured minus freely predicted position of the held-out multisine, over the motion's RMS, per joint."""
    other = settled_period(config, facts, samples, HELD_OUT)
    predicted = predict(estimate, other.torque, other.rate, other.command_to_sample)
    error = other.position - predicted
    motion = other.position - np.nanmean(other.position, axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.nanmean(error**2, axis=1) / np.nanmean(motion**2, axis=1)))
