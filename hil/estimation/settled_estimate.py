"""Two-stage estimation from a run's settled period, and its validation on a held-out multisine."""

import logging
import time
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.errors import RecordingCutShort
from hil.estimation.chain_estimate import estimate_chain_run
from hil.estimation.drive.currents import settled_current_findings
from hil.estimation.drive.supply import supply_notes, supply_sag
from hil.estimation.model_from_config import lever_of, voltage_driven, wanted_model
from hil.estimation.physical import physical_of
from hil.estimation.pilot_limit import torque_limit
from hil.estimation.plausibility import borrowed_length, conflicts_of, doubts
from hil.estimation.result import Checks, make_result
from hil.estimation.result_checks import describe_choice, describe_validation, describe_verdict
from hil.estimation.settled_causes import cause_of_residual
from hil.estimation.settled_period import settled_period
from hil.estimation.settled_warnings import warnings_of
from hil.estimation.slips.position_jumps import jump_disturbances
from hil.estimation.slips.rest_shift import rest_shift_warnings
from hil.estimator.arrays import Array
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.selection.candidates import candidates, considered
from hil.estimator.selection.drift import Drift, TorqueChange, drifting, friction_change, torque_change
from hil.estimator.selection.given import fit_given
from hil.estimator.selection.other_period import predict_period
from hil.estimator.selection.settled import choose
from hil.estimator.selection.steadied import steadied
from hil.estimator.selection.trial import Choice
from hil.estimator.selection.validation import validate
from hil.estimator.selection.verdict import GOOD_PREDICTION, Evidence, judge
from hil.estimator.simulation.back_emf import neglected
from hil.plan.plan import HELD_OUT, IDENTIFY
from hil.plan.stabiliser import stabiliser_share
from hil.results.parts import RunTiming
from hil.results.result import SettledResult
from hil.runs.period_file import PlayedPeriod, save_periods
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFacts, RunFolder
from hil.runs.timing import timing

__all__ = ["estimate_run"]

log = logging.getLogger(__name__)


def estimate_run(run: RunFolder, executor: Executor | None = None) -> SettledResult:
    """Estimate from the recording in `run`, write its result.json and return the result.

    executor: runs fits in advance, in case `friction = "auto"` needs them. Raises HilError, EstimationError.
    """
    config, facts = run.load_config(), run.load_facts()
    if config.is_chain:
        return estimate_chain_run(run, config, facts)
    samples = load_samples(run.samples_path, len(config.joints))
    started = time.perf_counter()
    period = settled_period(config, facts, samples, IDENTIFY)
    other, cut_short = _held_out(config, facts, samples)
    between = None if other is None else _mean_time(facts, samples, HELD_OUT) - _mean_time(facts, samples, IDENTIFY)
    estimate, choice = _estimate(config, period, other, between, run.load_starts(), executor)
    played = {IDENTIFY: PlayedPeriod(period.rate, period.torque, period.position, estimate.position)}
    period = period if choice is None else choice.period
    is_corrected = choice is not None and choice.drift is not None
    left_out = candidates(period, estimate, {})
    estimate = replace(estimate, covariance=_with_neglected(considered(period, estimate), estimate))
    drift = None if other is None or between is None else friction_change(other, estimate, between)
    jumps, currents = jump_disturbances(config, facts, samples), settled_current_findings(config, samples)
    torque = _torque_instead(other, estimate, drift)
    if jumps:
        drift = None  # it was not friction that changed
    if drift is not None:
        left = drift.after_correction() if is_corrected else drift
        estimate = replace(estimate, covariance=drifting(period, estimate, left))
    if torque is not None:
        drift = None  # friction may have changed too, so the standard errors still include its effect
    if other is not None:
        played[HELD_OUT] = _predicted(estimate, other, drift, is_corrected)
    held_out = played[HELD_OUT].relative_error if HELD_OUT in played else None
    as_fitted = _as_fitted(estimate, other, drift)
    validation = validate(period, estimate, config.arm.gravity > 0.0)
    conflicts = conflicts_of(config, estimate)
    wrong = doubts(config, estimate, float(np.abs(period.torque).max()), conflicts)
    notes = (*supply_notes(config, supply_sag(config, samples)), *borrowed_length(config, estimate))
    limit = torque_limit(config, samples)
    evidence = Evidence(
        None if other is None else played[HELD_OUT].error_beyond(other.noise),
        None if other is None or as_fitted is None else as_fitted.error_beyond(other.noise),
        left_out,
        drift,
        torque,
        (*jumps, *currents.disturbances),
        wrong,
        notes,
        tried_all=choice is not None,
        torque_limit=limit,
        conflicts=conflicts,
        cause=cause_of_residual(config, period, validation),
        ended_early=bool(cut_short),
    )
    judged = judge(estimate, validation, evidence)
    checks = Checks(
        describe_validation(validation, held_out, None if as_fitted is None else as_fitted.relative_error),
        describe_verdict(judged),
        (*currents.warnings, *warnings_of(config, facts, samples, period), *cut_short),
        None if choice is None else describe_choice(choice),
    )
    seconds = round(time.perf_counter() - started, 3)
    kept_time = RunTiming.of(timing(samples, config.experiment.rate), seconds)
    result = make_result(
        config, facts.config, period, estimate, checks, kept_time, _mean_time(facts, samples, IDENTIFY)
    )
    if config.known is not None:
        result = replace(result, physical=physical_of(result, config.known.quantities(), config.arm.gravity))
    if config.stabiliser is not None:
        chosen = (samples["phase"] == Phase.PERIODIC) & (samples["segment"] == facts.segments.index(IDENTIFY))
        result = replace(result, stabiliser=stabiliser_share(config, samples[chosen]))
    result = replace(result, warnings=(*result.warnings, *rest_shift_warnings(config, samples, result)))
    log.info("%s: %s, %d parameters, %.3g s", run.path, result.method, len(result.quantities), seconds)
    for warning in result.warnings:
        log.warning("%s: %s", run.path, warning)
    save_periods(run.path, played)
    run.write_result(result)
    return result


def _held_out(config: Config, facts: RunFacts, samples: NDArray[np.void]) -> tuple[SettledPeriod | None, list[str]]:
    """The settled period of the held-out multisine, if there is one, and a warning if the recording ends too early."""
    if HELD_OUT not in facts.segments:
        return None, []
    try:
        return settled_period(config, facts, samples, HELD_OUT), []
    except RecordingCutShort:
        return None, [
            "The recording ended before the held-out motion had settled, so the prediction of another motion was not "
            "validated. Identify again to validate it."
        ]


def _torque_instead(other: SettledPeriod | None, estimate: Estimate, drift: Drift | None) -> TorqueChange | None:
    """The constant torque that explains the held-out period better than a change in friction; None if there is none."""
    if other is None or drift is None:
        return None
    # A torque that friction cannot explain makes the change of friction so uncertain that none is detected.
    if not drift.is_seen and relative_error(other.position, predict_period(estimate, other)).max() <= GOOD_PREDICTION:
        return None
    torque = torque_change(other, estimate)
    return torque if torque.explains_better_than(drift) else None


def _predicted(estimate: Estimate, other: SettledPeriod, drift: Drift | None, is_corrected: bool) -> PlayedPeriod:
    """Predict the held-out period with the friction that the arm had during that period. is_corrected: whether to
    correct the prediction for friction that changes within the period, as for the fitted period.
    """
    if drift is None:
        return PlayedPeriod(other.rate, other.torque, other.position, predict_period(estimate, other))
    later = drift.at_the_later(estimate) if drift.is_seen else estimate
    predicted = predict_period(later, steadied(other, later, drift) if is_corrected else other)
    return PlayedPeriod(other.rate, other.torque, other.position, predicted)


def _as_fitted(estimate: Estimate, other: SettledPeriod | None, drift: Drift | None) -> PlayedPeriod | None:
    """The held-out period predicted with the friction of the fitted period; None if friction did not change."""
    if other is None or drift is None or not drift.is_seen:
        return None
    return PlayedPeriod(other.rate, other.torque, other.position, predict_period(estimate, other))


def _with_neglected(covariance: Array, estimate: Estimate) -> Array:
    """Add the variance due to effects that the back-EMF model neglects."""
    wider = covariance.copy()
    for name, std in neglected(Physics.of(estimate.parameters)).items():
        place = estimate.names.index(name)
        wider[place, place] += std**2
    return wider


def _mean_time(facts: RunFacts, samples: NDArray[np.void], role: str) -> float:
    """Mean time of the last period of a multisine, on the port's clock [s]."""
    phase, segment, period = (samples[name].astype(np.int64) for name in ("phase", "segment", "period"))
    deadline: Array = samples["deadline"]
    played = (phase == Phase.PERIODIC) & (segment == facts.segments.index(role))
    return float(deadline[played & (period == period[played].max())].mean())


def _estimate(
    config: Config,
    period: SettledPeriod,
    other: SettledPeriod | None,
    between: float | None,
    starts: list[dict[str, float]],
    executor: Executor | None,
) -> tuple[Estimate, Choice | None]:
    """Fit the configured model. If its friction is "auto", choose among models; otherwise the Choice is None."""
    wanted, by_voltage, lever = config.model, voltage_driven(config), lever_of(config)
    if wanted.friction == "auto":
        choice = choose(
            [period],
            other,
            wanted.drive,
            torque_scale=wanted.torque_scale,
            by_voltage=by_voltage,
            lever=lever,
            starts=starts,
            seconds=between,
            executor=executor,
        )
        return choice.estimate, choice
    return fit_given(period, wanted_model(wanted, len(config.joints), by_voltage, lever), starts), None
