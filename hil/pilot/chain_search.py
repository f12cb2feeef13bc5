"""Identify a spatial arm from its URDF, limits and rest pose, in runs of increasing amplitude.

pilot     a small fraction of the designed path, safe for every arm of the prior ensemble
steps     larger fractions, safe for the ensemble as updated after each run
full      the designed path at the largest safe fraction, and a held-out path
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hil.config.schema import Config
from hil.dry_run.prediction import peaks_of
from hil.dry_run.resting_stops import passed_rest
from hil.errors import DidNotMove, ExperimentError, NotSettled
from hil.estimation.after_a_stop import can_be_estimated
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Watch
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config
from hil.pilot.chain_shares import PILOT_SHARES, SHARES, Found, SafeShares, step_config
from hil.pilot.punctual import punctual
from hil.pilot.steps import Step, ended_early, tells_of_the_arm
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from hil.setup.lying import from_where_it_lies, said_of_the_rest
from hil.setup.session.servo_session import Say, servo_session
from hil.setup.unmoved import wait_for_rest

MOST_STEPS = 6
AFTER_LIMIT = 0.7
RAISED = 1.3
"""If the amplitude that is safe now is at least this multiple of the amplitude of the last run, another step precedes
the full run.
"""

MOST_RAISE = 2.5
"""Largest ratio of the amplitudes of successive runs."""

SILENT_S = 30.0
"""Longest time without a message while searching for a safe motion [s]."""


class Said:
    """Passes messages on, and reports progress when there has been no message for a while.

    now: returns the time [s].
    """

    def __init__(self, say: Say, now: Callable[[], float] = time.monotonic) -> None:
        self._say, self._now = say, now
        self._at = now()
        self._trying = ""

    def trying(self, which: str) -> None:
        self._trying = which

    def say(self, text: str) -> None:
        self._at = self._now()
        self._say(text)

    def tell(self, done: int, total: int) -> None:
        """Report the progress of simulations after every SILENT_S without a message."""
        which = f"{self._trying}, " if self._trying else ""
        self._after_silence(
            f"Still looking for a motion that is safe for all arms: {which}{done} of {total} simulations of this "
            "amplitude."
        )

    def designing(self, done: int, total: int) -> None:
        """Report the progress of a path's design after every SILENT_S without a message."""
        self._after_silence(f"Still designing a path: {done} of {total} steps.")

    def _after_silence(self, text: str) -> None:
        if self._now() - self._at >= SILENT_S:
            self.say(text)


@dataclass(kw_only=True)
class ChainSearch(SafeShares):
    """State of the search: the runs so far and the current belief about the arm."""

    run: RunFolder
    shown_path: Path
    watch: Watch
    steps: list[Step] = field(default_factory=list)

    @classmethod
    def of(cls, config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say) -> "ChainSearch":
        """Design the paths and draw the prior ensemble. Raises NoSafeTorque, ConfigError, ArmFileError."""
        config = chain_config(config)
        belief = ChainBelief.prior(config)
        said = Said(say)
        paths = Paths.of(config, belief.torque, tell=said.designing)
        said.say(
            "Designed a path that reduces the standard error of every base parameter to "
            f"{100 * paths.identify.worst:.2g} % of its prior value or less (held-out path, with random phases: "
            f"{100 * paths.held_out.worst:.2g} %)."
        )
        return cls(
            *(config, belief, paths, said.say),
            tell=said.tell,
            designing=said.designing,
            trying=said.trying,
            run=run,
            shown_path=shown_path,
            watch=watch,
        )

    def step(self, name: str, folder: str, shares: tuple[float, ...]) -> Found:
        """Play one step, compare it with the prediction, and update the belief.

        name: name of the step for messages. folder: name of its run folder. shares: fractions of the paths' amplitude
        to try, in this order. Returns the fraction that was played, with its prediction.
        """
        config = step_config(self.config)
        found = self.safe(config, shares, shares[0] if self.steps else np.inf)
        below = self.run.below(folder, config)
        error = self.play(config, below, name, found)
        if error is not None:
            self.limit_after(error, found)
        self.learn(config, below)
        return found

    def limit_after(self, error: ExperimentError, found: Found) -> None:
        """Reduce the largest allowed amplitude after a stopped run, unless the motion never settled or a joint did not
        move.
        """
        if not isinstance(error, NotSettled | DidNotMove):
            self.cap = min(self.cap, AFTER_LIMIT * found.share)

    def play(self, config: Config, folder: RunFolder, name: str, found: Found) -> ExperimentError | None:
        """Play a run, and set `last` to the fraction of the amplitude that the run used. Return the error that ended
        the run early, or None.

        Errors that are informative about the arm are returned; all others are raised.
        """
        error, self.last = None, found.share
        try:
            self.torque = punctual(
                lambda: run_experiment(config, folder, self.shown_path, self.watch, found.plan, self.belief.arms),
                config,
                folder,
                name,
                self.say,
            )
        except ExperimentError as stopped:
            if not tells_of_the_arm(stopped):
                raise
            self.torque, error = " ".join(getattr(stopped, "__notes__", [])), stopped
        self._compare(config, folder, name, found, error)
        return error

    def learn(self, config: Config, folder: RunFolder) -> None:
        """Update the belief from a recording, and note on which sides of its rest angle each joint has been."""
        samples = load_samples(folder.samples_path, len(config.joints))
        self.belief = self.belief.learn(config, samples)
        found = passed_rest(config, samples["position"])
        self.passed = found if self.passed is None else self.passed | found

    def _compare(
        self, config: Config, folder: RunFolder, name: str, found: Found, error: ExperimentError | None
    ) -> None:
        samples = load_samples(folder.samples_path, len(config.joints))
        peaks = peaks_of(config, samples["position"].T, samples["velocity"].T, samples["goal_current"].T)
        foreseen = found.foreseen.peaks
        torque = found.plan.segments[0].peak_goal * np.array([joint.torque_per_goal for joint in config.joints])
        step = Step(name, torque, foreseen.median, foreseen.quantile, peaks, str(error or ""))
        self.steps.append(step)
        self.say(
            f"{step}\n  Amplitude: {100 * found.share:.0f} % of the designed path's; predicted clearance: "
            f"{found.foreseen}."
        )
        if error is not None:
            self.say(f"{ended_early(name, error)} {self.torque}")
        elif not step.within:
            self.say(
                f"{name}: measured peaks exceed those of 99 % of the simulated arms; the arm differs from the "
                "assumptions."
            )


def identify_chain_in_steps(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say
) -> tuple[str, SettledResult]:
    """Identify a spatial arm from its description, limits and rest pose. Returns a sentence about the torque state, and
    the result.

    Raises the same errors as a run, and NoSafeTorque.
    """
    with StopRequest(), servo_session(config, run.path, say) as bus:
        if from_where_it_lies(config, bus.read_positions()) is not config and (moving := wait_for_rest(bus)):
            raise ExperimentError(moving)
        lies = from_where_it_lies(config, bus.read_positions())
        if lies is not config:
            say(said_of_the_rest(config, lies))
        search = ChainSearch.of(lies, run, shown_path, watch, say)
        search.step("Pilot", "pilot", PILOT_SHARES)
        while len(search.steps) < MOST_STEPS and not search.is_exhausted:
            wanted = search.safe(step_config(search.config), SHARES)
            if wanted.share <= RAISED * search.last and search.cap == 1.0:
                break
            if len(search.steps) > 1 and wanted.share <= MOST_RAISE * search.last:
                break
            number = len(search.steps) + 1
            share = min(wanted.share, MOST_RAISE * search.last)
            search.step(f"Step {number}", f"step-{number}", tuple(share * each for each in (1.0, 0.8, 0.6)))
        torque = _full(search)
        result = replace(estimate_run(run), steps=tuple(step.played() for step in search.steps))
        run.write_result(result)
    return torque, result


def _full(search: ChainSearch) -> str:
    """Play the full run; repeat it with a smaller amplitude if it exceeds a limit or never settles.

    If the last run fails only in its second path, the estimate uses the first path alone: the second one is needed only
    for validation.
    """
    tries = 3
    for number in range(1, tries + 1):
        config = search.config
        found = search.safe(config, SHARES, MOST_RAISE * search.last)
        search.run.write_played(config)
        error = search.play(config, search.run, "Full run", found)
        if error is None:
            return search.torque
        if number == tries:
            if isinstance(error, NotSettled | DidNotMove) and can_be_estimated(search.run.path):
                search.say("The first path had already been recorded; the estimate uses only that path.")
                return search.torque
            raise error
        search.learn(config, search.run)
        before = search.cap
        search.limit_after(error, found)
        how = "less amplitude" if search.cap < before else "the friction learned from this run"
        search.say(f"Repeating with {how}.")
        search.run.set_aside(f"stopped-{number}", config)
    raise AssertionError  # the loop returns or raises
