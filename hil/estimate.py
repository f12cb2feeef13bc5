"""From a run folder to its result: settled period, both stages, the check on a multisine that was not used."""

import time
from typing import Any

from estimator.choice import Choice, choose
from estimator.identify import Estimate, identify, predict
from estimator.model import Model
from estimator.period import SettledPeriod
from estimator.validation import validate
from estimator.verdict import judge
from hil.config import Config
from hil.period_file import PlayedPeriod, save_periods
from hil.plan import HELD_OUT, IDENTIFY
from hil.recording import load_samples
from hil.result import make_result
from hil.result_checks import describe_choice, describe_validation, describe_verdict
from hil.run_folder import RunFolder
from hil.settled import settled_period
from hil.timing import timing
from hil.warnings import warnings_of


def estimate_run(run: RunFolder) -> dict[str, Any]:
    """Estimate from the recording in `run` and write its result.json; the result. Raises HilError, EstimationError."""
    config, facts = run.load_config(), run.load_facts()
    samples = load_samples(run.samples_path, len(config.joints))
    started = time.perf_counter()
    period = settled_period(config, facts, samples, IDENTIFY)
    other = settled_period(config, facts, samples, HELD_OUT) if HELD_OUT in facts.segments else None
    estimate, choice = _estimate(config, period, other)
    played = {IDENTIFY: PlayedPeriod(period.rate, period.torque, period.position, estimate.position)}
    if other is not None:
        predicted = predict(estimate, other.torque, other.rate, other.command_to_sample)
        played[HELD_OUT] = PlayedPeriod(other.rate, other.torque, other.position, predicted)
    held_out = played[HELD_OUT].relative_error if HELD_OUT in played else None
    validation = validate(period, estimate)
    checked = {
        **describe_validation(validation, held_out),
        "verdict": describe_verdict(judge(estimate, validation, held_out)),
        "warnings": warnings_of(config, facts, samples, period),
        **({"model_choice": describe_choice(choice)} if choice else {}),
    }
    seconds = round(time.perf_counter() - started, 3)
    kept_time = {**timing(samples, config.experiment.rate), "estimation_seconds": seconds}
    result = make_result(config, facts.config, period, estimate, checked, kept_time)
    save_periods(run.path, played)
    run.write_result(result)
    return result


def _estimate(config: Config, period: SettledPeriod, other: SettledPeriod | None) -> tuple[Estimate, Choice | None]:
    """The estimate of the model that the configuration asks for, or of the one chosen, with how it was."""
    wanted = config.model
    if wanted.friction == "auto":
        choice = choose([period], other, wanted.drive)
        return choice.estimate, choice
    terms = {"asymmetry": wanted.asymmetry, "ripple": wanted.ripple, "zeros": wanted.zeros}
    return identify(period, Model(len(config.joints), wanted.friction, wanted.drive, **terms)), None
