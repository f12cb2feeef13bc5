"""Identification from link lengths alone: the amplitude search, the full run, and its estimate."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude
from hil.errors import DidNotMove, ExperimentError
from hil.estimation.settled_estimate import estimate_run
from hil.estimator.arrays import Array
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Watch
from hil.pilot.chain_search import identify_chain_in_steps
from hil.pilot.options import PilotOptions
from hil.pilot.search import Search, with_torque
from hil.pilot.steps import Played, Player
from hil.plan.plan import ROLES
from hil.plan.supply_speed import lowered, within_supply
from hil.results.result import Result, SettledResult
from hil.runs.run_folder import RunFolder
from hil.setup.session.servo_session import Say, servo_session


def identify_in_steps(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say, earlier: Result | None = None
) -> tuple[str, SettledResult]:
    """Identify an arm from link lengths alone, or from an `earlier` result for the same arm.

    Returns a sentence about the torque state, and the result.

    Raises the same errors as a run, and ExperimentError if a joint does not move at its current limit.
    """
    given, config = config, within_supply(config)
    for sentence in lowered(given, config):
        say(sentence)
    if config.is_chain:
        return identify_chain_in_steps(config, run, shown_path, watch, say)
    # A stop request in one step also cancels all later ones. Servo settings are saved and restored once for all steps,
    # because EEPROM wears.
    with StopRequest(), servo_session(config, run.path, say):
        search = Search.of(config, run, Player(shown_path, watch, say), earlier=earlier)
        played = _full(search, *search.find())
        run.write_starts([search.belief.middle])
        result = replace(estimate_run(run), steps=tuple(step.played() for step in search.steps))
        run.write_result(result)
    return played.torque, result


def _full(search: Search, config: Config, found: Amplitude) -> Played:
    """Play the full run; repeat it with less torque if it exceeded a limit, with other waves if it did not settle, and
    at higher frequencies if friction held a joint.

    Friction may stop an arm in a different place in every period, however many periods are played, so each repetition
    tolerates a larger difference between periods. The fit does not need identical periods, and the verdict says how
    well they are predicted.
    """
    run, say, options = search.run, search.player.say, search.options
    number = unlike = 0
    while True:
        number += 1
        chosen = with_torque(config, found.peak_torque)
        run.write_played(chosen)
        played = search.play(chosen, run, "Full run", found)
        search.learn(chosen, played)
        if played.error is None:
            return played
        unlike += played.unlike_before
        if number == options.max_full_runs or unlike == options.max_unlike_runs:
            raise played.error
        run.set_aside(f"stopped-{number}", chosen)
        if played.passed_limit:
            plan = found.plan
        else:
            search.cap = _after_unsettled(search, found, played.error)
            search.config = _tolerant(search.config, options.max_settle_within)
            if isinstance(played.error, DidNotMove) and (band := _faster(search.config, options)):
                experiment = search.config.experiment.model_copy(update={"band": band})
                search.config = search.config.model_copy(update={"experiment": experiment})
                say(
                    "At higher frequencies, more torque is safe and friction does not hold the arm: the waves now "
                    f"cover {band[0]:g} to {band[1]:g} Hz."
                )
            plan = search.waves(search.held)
        before = found.peak_torque
        config, found = search.moving(plan)
        how = "less torque" if (found.peak_torque < before).any() else "another waveform"
        within = search.config.experiment.settle_within
        more = "" if played.passed_limit else f", with settle_within = {within:g} instead of the file's value"
        say(f"Repeating with {how}{more}.")


def _after_unsettled(search: Search, found: Amplitude, error: ExperimentError) -> Array:
    """Largest torque (joints,) [N m] of the next run, after `error` ended a run within all limits.

    With little friction, a large motion may never settle; less torque helps. If torque hardly exceeds dry friction,
    however, friction stops the joint in a different place each time, and less torque would not move it at all.
    """
    middle, options = search.belief.middle, search.options
    if isinstance(error, DidNotMove):
        return np.asarray(options.breakaway_raise * found.peak_torque)
    friction = np.array([middle.get(f"coulomb_{joint + 1}", 0.0) for joint in range(len(search.config.joints))])
    lowered = options.torque_after_unsettled * found.peak_torque
    least = options.torque_over_friction * friction
    return np.maximum(lowered, np.minimum(found.peak_torque, least))


def _faster(config: Config, options: PilotOptions) -> list[float]:
    """The experiment's band [Hz], with its lower limit raised as far as `options` allow; [] if it cannot be raised.

    If static friction far exceeds kinetic friction, a torque that moves the joint at low frequencies moves it too far.
    """
    experiment = config.experiment
    if experiment.band is None:
        return []
    low, high = experiment.band
    raised = round(min(options.band_raise * low, options.max_low * high) * experiment.period) / experiment.period
    return [raised, high] if raised > low else []


def _tolerant(config: Config, most: float) -> Config:
    """The configuration with other multisines. The permitted difference between successive periods is doubled, up to
    `most`.
    """
    experiment = config.experiment
    within = min(2.0 * experiment.settle_within, max(experiment.settle_within, most))
    update = {"seed": experiment.seed + len(ROLES), "settle_within": within}
    return config.model_copy(update={"experiment": experiment.model_copy(update=update)})
