"""From URDF, limits and rest pose to an identified spatial arm: pilot, steps of increasing amplitude, full run.

pilot     a small fraction of the designed path, safe for every arm of the prior ensemble
steps     larger fractions, safe for the ensemble as updated after each run
full      the designed path at the largest safe fraction, and a held-out path
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.chain_prediction import ChainPrediction, predict_chain
from hil.dry_run.chain_stop import foreseen_stops
from hil.dry_run.chain_summary import unsafe
from hil.dry_run.prediction import peaks_of
from hil.errors import DidNotMove, ExperimentError, NoSafeTorque, NotSettled
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Watch
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config
from hil.pilot.punctual import punctual
from hil.pilot.steps import Say, Step, tells_of_the_arm
from hil.plan.chain_model import limit_names
from hil.plan.chain_plan import NoHeadroom
from hil.plan.plan import Plan
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from hil.setup.servo_session import servo_session

Array = NDArray[np.float64]

SEARCH_ARMS, ARMS = 24, 72
"""Number of arms simulated while searching for a share, and to confirm the one found."""

PILOT_SHARES = (0.3, 0.2, 0.12, 0.06)
SHARES = (1.0, 0.88, 0.76, 0.64, 0.52, 0.4, 0.28, 0.18)
SMALL = 0.5
"""Fraction of the wanted share below which other paths, with more reserve, are designed."""

REDESIGNS = 2
MOST_STEPS = 6
AFTER_LIMIT = 0.7
RAISED = 1.3
"""Smallest ratio of the safe share to that of the previous run for which another step precedes the full run."""

MOST_RAISE = 2.5
"""Largest ratio of a step's share of the amplitude to that of the previous run."""


@dataclass(frozen=True)
class Found:
    """A safe share of the amplitude, with its plan and the predicted motion."""

    share: float
    plan: Plan
    foreseen: ChainPrediction


@dataclass
class ChainSearch:
    """Runs so far and the current belief.

    last: share of the previous run; cap: largest share after a run that exceeded a limit. Both are shares of `paths`,
    and are converted when these are replaced.
    """

    given: Config
    run: RunFolder
    shown_path: Path
    watch: Watch
    say: Say
    belief: ChainBelief
    paths: Paths
    steps: list[Step] = field(default_factory=list)
    cap: float = 1.0
    last: float = np.inf

    @classmethod
    def of(cls, config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say) -> "ChainSearch":
        """Design the paths and draw the prior ensemble. Raises NoSafeTorque, ConfigError, ArmFileError."""
        config = chain_config(config)
        belief = ChainBelief.prior(config)
        paths = Paths.of(config, belief.torque)
        say(
            f"Designed a path that leaves the worst base parameter {100 * paths.identify.worst:.2g} % of its prior "
            f"standard error (held-out path, with random phases: {100 * paths.held_out.worst:.2g} %)."
        )
        return cls(config, run, shown_path, watch, say, belief, paths)

    @property
    def config(self) -> Config:
        """The configuration with a stabiliser suited to the current ensemble."""
        return self.belief.with_stabiliser(self.given)

    def safe(self, config: Config, shares: tuple[float, ...], most: float = np.inf) -> Found:
        """Find the first of the `shares` of the designed path that is safe for all simulated arms.

        most: largest share; for other paths, the share with the same amplitude. The shares are scaled to it.

        If that share is small, other paths with more reserve are designed; of all safe ones, the most informative is
        kept. Raises NoSafeTorque if no share of any path is safe.
        """
        most = min(most, self.cap) if self.cap < 1.0 else most
        found, why, shortage = self._largest(config, _up_to(most, shares))
        reserve = self.paths.reserve
        for _ in range(REDESIGNS):
            if found is not None and found.share >= SMALL * min(most, shares[0]):
                break
            former, reserve = self.paths, reserve.larger(shortage)
            try:
                self.paths = Paths.of(self.given, self.belief.torque, reserve)
            except NoSafeTorque:
                break
            times = self.paths.amplitude_over(former)
            other, other_why, shortage = self._largest(config, _up_to(most / times, shares))
            if other is None or (found is not None and self._worth(former, found) <= self._worth(self.paths, other)):
                self.paths = former
            else:
                found = other
                most, self.last = most / times, self.last / times
                self.cap = min(self.cap / times, 1.0) if self.cap < 1.0 else 1.0
                self.say("Designed another path, which stays farther from the limits.")
            why = why if other is not None else other_why
        if found is None:
            raise NoSafeTorque(
                f"{config.path}: no motion is safe for all arms consistent with what is known, not even "
                f"{100 * shares[-1]:.0f} % of the designed path: {why}. {_remedy(config)}"
            )
        return found

    def _largest(self, config: Config, shares: tuple[float, ...]) -> tuple[Found | None, str, float]:
        """The first safe share of the paths, why a larger one is not, and how much clearance that one lacks [m]."""
        why, shortage = "", 0.0
        for share in shares:
            try:
                plan = self.paths.plan(config, self.belief.torque, share)
            except NoHeadroom as error:  # the arm is heavier than the paths were designed for
                why = str(error)
                continue
            for count in (SEARCH_ARMS, ARMS):
                foreseen = predict_chain(config, plan, self.belief.arms.first(count))
                not_safe = unsafe(config, foreseen)
                shortage = max(shortage, -float(foreseen.rooms.min()))
                if not_safe:
                    break
            not_safe = not_safe or self._unsafe_stop(config, plan)
            if not not_safe:
                return Found(share, plan, foreseen), why, shortage
            why = not_safe
        return None, why, shortage

    def _worth(self, paths: Paths, found: Found) -> float:
        """Worst relative standard error of the base parameters after the found share of a path."""
        return paths.designer.worth(paths.designer.scaled(paths.identify, found.share))[0]

    def _unsafe_stop(self, config: Config, plan: Plan) -> str:
        """Explain why a stop would not lower the arm safely; "" if it would."""
        return "" if config.safety.stop == "cut" else foreseen_stops(config, plan, self.belief.arms.first(ARMS)).unsafe

    def step(self, name: str, folder: str, shares: tuple[float, ...]) -> Found:
        """Play one step, compare it with the prediction, and update the belief."""
        config = step_config(self.config)
        found = self.safe(config, shares, shares[0] if self.steps else np.inf)
        below = self.run.below(folder, config)
        error = self.play(config, below, name, found)
        if error is not None:
            self.limit_after(error, found)
        self.learn(config, below)
        return found

    def limit_after(self, error: ExperimentError, found: Found) -> None:
        """Allow less of the path after a run that exceeded a limit, but not after one in which friction held a
        joint.
        """
        if not isinstance(error, NotSettled | DidNotMove):
            self.cap = min(self.cap, AFTER_LIMIT * found.share)

    def play(self, config: Config, folder: RunFolder, name: str, found: Found) -> ExperimentError | None:
        """Play a run and set `last` to its share; return the error that ended it early, or None.

        Only errors that are informative about the arm are returned; all others are raised.
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
        """Update the belief with the recording in a folder."""
        self.belief = self.belief.learn(config, load_samples(folder.samples_path, len(config.joints)))

    def _compare(
        self, config: Config, folder: RunFolder, name: str, found: Found, error: ExperimentError | None
    ) -> None:
        samples = load_samples(folder.samples_path, len(config.joints))
        peaks = peaks_of(config, samples["position"].T, samples["velocity"].T, samples["goal_current"].T)
        foreseen = found.foreseen.peaks
        torque = found.plan.segments[0].peak_goal * np.array([joint.torque_per_goal for joint in config.joints])
        step = Step(name, torque, foreseen.median, foreseen.quantile, peaks, str(error or ""))
        self.steps.append(step)
        self.say(f"{step}\n  {100 * found.share:.0f} % of the path; predicted clearance: {found.foreseen}.")
        if error is not None:
            self.say(f"{name} ended early: {error} {self.torque}")
        elif not step.within:
            self.say(
                f"{name}: measured peaks exceed those of 99 % of the simulated arms; the arm differs from the "
                "assumptions."
            )


def _up_to(most: float, shares: tuple[float, ...]) -> tuple[float, ...]:
    """Return the shares, scaled so that the first is at most `most`."""
    return tuple(min(1.0, most / shares[0]) * share for share in shares)


def _remedy(config: Config) -> str:
    """Return the changes with which a user may make a path safe."""
    spread = 0.3 if config.arm.prior is None else config.arm.prior.spread
    return (
        "Depending on the reason, these changes help: a rest_pose farther from limits and obstacles; a wider "
        "position_limit; more room in [clearance] (floor, boxes, margin), if there is more; a larger "
        f"{limit_names(config)} or velocity_limit; or masses in the URDF that are known better, with [arm.prior] "
        f"spread below {spread:g}."
    )


def identify_chain_in_steps(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say
) -> tuple[str, SettledResult]:
    """Identify a spatial arm from its description, limits and rest pose. Returns the torque state and the result.

    Raises what a run raises, and NoSafeTorque.
    """
    with StopRequest(), servo_session(config, run.path, say):
        search = ChainSearch.of(config, run, shown_path, watch, say)
        search.step("Pilot", "pilot", PILOT_SHARES)
        while len(search.steps) < MOST_STEPS:
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
    """Play the full run; repeat it with a smaller amplitude if it exceeds a limit or never settles."""
    tries = 3
    for number in range(1, tries + 1):
        config = search.config
        found = search.safe(config, SHARES, MOST_RAISE * search.last)
        search.run.write_played(config)
        error = search.play(config, search.run, "Full run", found)
        if error is None:
            return search.torque
        if number == tries:
            raise error
        search.learn(config, search.run)
        before = search.cap
        search.limit_after(error, found)
        how = "less amplitude" if search.cap < before else "the friction learned from this run"
        search.say(f"Repeating with {how}.")
        search.run.set_aside(f"stopped-{number}", config)
    raise AssertionError  # the loop returns or raises


def step_config(config: Config) -> Config:
    """The configuration of a step: one path, run for two periods whether or not it settles."""
    update: dict[str, Any] = {"held_out": False, "max_settling_periods": 1, "periods": 1, "settle_within": 0.99}
    return config.model_copy(update={"experiment": config.experiment.model_copy(update=update)})
