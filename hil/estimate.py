"""From a run folder to its result: settled period, both stages, the check on a multisine that was not used."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.identify import Estimate, identify, predict
from estimator.model import Model
from estimator.physics import Physics
from hil.config import Config
from hil.period_file import PlayedPeriod, save_periods
from hil.physical import physical_entries
from hil.plan import HELD_OUT, IDENTIFY
from hil.recording import Phase, load_samples
from hil.result import make_result
from hil.run_folder import RunFacts, RunFolder
from hil.settled import settled_period
from hil.stabiliser import stabiliser_share
from hil.timing import timing


def estimate_run(run: RunFolder) -> dict[str, Any]:
    """Estimate from the recording in `run` and write its result.json; the result. Raises HilError, EstimationError."""
    config, facts = run.load_config(), run.load_facts()
    samples = load_samples(run.samples_path, len(config.joints))
    started = time.perf_counter()
    period = settled_period(config, facts, samples, IDENTIFY)
    model = Model(len(config.joints), config.model.friction, config.model.drive)
    estimate = identify(period, model)
    played = {IDENTIFY: PlayedPeriod(period.rate, period.torque, period.position, estimate.position)}
    if HELD_OUT in facts.segments:
        played[HELD_OUT] = _held_out(config, facts, samples, estimate)
    seconds = round(time.perf_counter() - started, 3)
    kept_time = {**timing(samples, config.experiment.rate), "estimation_seconds": seconds}
    held_out = played[HELD_OUT].relative_error if HELD_OUT in played else None
    result = make_result(config, facts.config, period, estimate, held_out, kept_time)
    if config.known is not None:
        result["physical"] = physical_entries(result, config.known.quantities(), config.arm.gravity)
    if config.stabiliser is not None:
        chosen = (samples["phase"] == Phase.PERIODIC) & (samples["segment"] == facts.segments.index(IDENTIFY))
        result["stabiliser"] = stabiliser_share(config, samples[chosen]).as_json()
    save_periods(run.path, played)
    run.write_result(result)
    return result


def _held_out(config: Config, facts: RunFacts, samples: NDArray[np.void], estimate: Estimate) -> PlayedPeriod:
    """The held-out multisine beside the model's free prediction of it."""
    other = settled_period(config, facts, samples, HELD_OUT)
    if other.stabiliser is None:
        predicted = predict(estimate, other.torque, other.rate, other.command_to_sample)
    else:
        arm, pose = Physics.of(estimate.parameters), np.array(config.arm.rest_pose)
        predicted = other.stabiliser.settled_positions(arm, pose, other.rate, other.command_to_sample)
    return PlayedPeriod(other.rate, other.torque, other.position, predicted)
