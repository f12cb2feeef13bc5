"""From link lengths to the result: the amplitude search, the full run, and its estimate."""

from dataclasses import replace
from pathlib import Path

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Watch
from hil.pilot.search import Search, with_torque
from hil.pilot.steps import Played, Player, Say
from hil.results.result import SettledResult
from hil.runs.run_folder import RunFolder
from hil.setup.servo_session import servo_session

MOST_TRIES = 3
"""Largest number of full runs if one exceeds a limit or does not settle."""

_BACK_OFF = 0.85
"""Torque factor after a run that never settled: large motion with little friction may never settle."""


def identify_in_steps(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say
) -> tuple[str, SettledResult]:
    """Identify an arm from link lengths only. Returns the sentence about the torque state and the result.

    Raises what a run raises, and ExperimentError if a joint does not move at its current limit.
    """
    # A stop request in one step also cancels all later ones. Servo settings are saved and restored once for all steps,
    # because EEPROM wears.
    with StopRequest(), servo_session(config, run.path, say):
        search = Search.of(config, run, Player(shown_path, watch, say))
        played = _full(search, *search.find())
        run.write_starts([search.belief.middle])
        result = replace(estimate_run(run), steps=tuple(step.played() for step in search.steps))
    run.write_result(result)
    return played.torque, result


def _full(search: Search, config: Config, found: Amplitude) -> Played:
    """Play the full run; repeat it with less torque if it exceeded a limit or did not settle."""
    run, say = search.run, search.player.say
    number = 0
    while True:
        number += 1
        chosen = with_torque(config, found.peak_torque)
        run.write_played(chosen)
        played = search.play(chosen, run, "Full run", found)
        search.learn(chosen, played)
        if played.error is None:
            return played
        if number == MOST_TRIES:
            raise played.error
        say("Repeating with less torque.")
        run.set_aside(f"stopped-{number}", chosen)
        if not played.passed_limit:
            search.cap = _BACK_OFF * found.peak_torque
        config = search.held
        found = search.amplitude(config, 1.0, found.plan)
