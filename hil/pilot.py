"""Pilot, then full: small first, identify, narrow what is known, dry-run again, and raise the torque to the limits.

Each step is a run of its own in a folder below the main one; the last is the main one. Every step says what it had
predicted and what was seen.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude, largest_amplitude
from hil.dry_run.ensemble import Ensemble, nominal, prior_ensemble, result_ensemble
from hil.dry_run.nearest_arms import likely_arms
from hil.dry_run.prediction import GUARDED, QUANTITIES, UNITS, peaks_of, predict
from hil.dry_run.waves import designed_plan, roomy_plan
from hil.errors import ExperimentError, NoSafeTorque
from hil.estimation.settled_estimate import estimate_run
from hil.estimator.errors import EstimationError
from hil.estimator.models.parameters import Physics
from hil.experiment.run import run_experiment
from hil.experiment.stream import Watch
from hil.plan.plan import Plan
from hil.results.parts import PlayedStep
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

Array = NDArray[np.float64]

PRIOR_ARMS = 128
RESULT_ARMS = 64
PILOT_SHARES = (0.4, 0.6, 0.8, 1.0)
"""Of the limits: how far the pilot goes; more where the arm did not move enough to be identified."""

MOST_STEPS = 4
CERTAIN = 0.85
"""A typical arm should come this far on its way to a limit; where it stays below, uncertainty costs too much range."""

REPLAYED = 0.05
"""Of the way to a limit: how far an identified arm's peaks may be from those of its own run and still be built upon."""

_PILOT_PERIOD_SHARE = 0.5
_SHAPE = ("coulomb_width", "stribeck", "load")
_STARTS = 3
"""Arms of the prior from which the pilot's estimate starts, beside the regression's."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Step:
    """One run on the way: its name, torque (joints,) [N m], predicted median and 99 % peaks and those seen
    (quantities, joints), in hil.dry_run.prediction.QUANTITIES.
    """

    name: str
    peak_torque: Array
    median: Array
    quantile: Array
    seen: Array

    @property
    def within(self) -> bool:
        """Whether all seen peaks that have a limit stayed within the predicted 99 %."""
        low, high, velocity = self.seen[:GUARDED]
        bounds = self.quantile
        return bool((low >= bounds[0]).all() and (high <= bounds[1]).all() and (velocity <= bounds[2]).all())

    def __str__(self) -> str:
        torque = ", ".join(f"{value:.2f}" for value in self.peak_torque)
        each = "; ".join(
            f"{QUANTITIES[row]} {_list(self.median[row])} predicted, at most {_list(self.quantile[row])}, "
            f"{_list(self.seen[row])} {UNITS[row]} seen"
            for row in range(GUARDED)
        )
        return f"{self.name}, peak torque {torque} N m: {each}."

    def played(self) -> PlayedStep:
        """As the result keeps it."""
        median, quantile, seen = (tuple(map(tuple, rows.tolist())) for rows in (self.median, self.quantile, self.seen))
        return PlayedStep(self.name, tuple(self.peak_torque.tolist()), median, quantile, seen, self.within)


def identify_in_steps(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say
) -> tuple[str, SettledResult]:
    """The whole way from link lengths to the result; the sentence about torque and the result.

    Raises what a run raises, and ExperimentError when the pilot cannot be identified at any safe torque.
    """
    steps: list[Step] = []
    result, full = _pilot(config, run, shown_path, watch, say, steps)
    while True:
        certain = _typical_share(full) >= CERTAIN
        if certain or len(steps) >= MOST_STEPS - 1:
            break
        say("What is known so far is too uncertain to go to the limits at once: one more run on the way.")
        between = _without_held_out(config)
        folder = run.below(f"step-{len(steps) + 1}", between)
        _play(between, folder, shown_path, watch, say, f"Step {len(steps) + 1}", full, steps)
        try:
            latest = _estimate(config, folder, full.plan, steps[-1], [result.values])
            full = next_amplitude(config, latest, full.plan, steps[-1])
        except (EstimationError, NoSafeTorque) as error:
            say(f"This step's estimate is not used, and the full run goes no farther than it did: {error}")
            break
        result = latest
    played = _with_torque(config, full.peak_torque)
    run.write_played(played)
    torque = _play(played, run, shown_path, watch, say, "Full run", full, steps)
    result = _estimate(played, run, full.plan, steps[-1], [result.values])
    result = replace(result, steps=tuple(step.played() for step in steps))
    run.write_result(result)
    return torque, result


def _pilot(
    config: Config, run: RunFolder, shown_path: Path, watch: Watch, say: Say, steps: list[Step]
) -> tuple[SettledResult, Amplitude]:
    """The first run, as small as can be identified; its result, and how far it lets the next one go."""
    pilot = pilot_config(config)
    ensemble = prior_ensemble(config, PRIOR_ARMS)
    for share in PILOT_SHARES:
        found = largest_amplitude(pilot, ensemble, share)
        played = _with_torque(pilot, found.peak_torque)
        folder = run.below(f"pilot-{len(steps) + 1}", played)
        try:
            _play(played, folder, shown_path, watch, say, "Pilot", found, steps)
            samples = load_samples(folder.samples_path, len(config.joints))
            starts = likely_arms(played, ensemble, found.plan, samples, _STARTS)
            result = _estimate(played, folder, found.plan, steps[-1], starts)
            return result, next_amplitude(config, result, found.plan, steps[-1])
        except (EstimationError, NoSafeTorque) as error:
            reason = error
            say(f"The pilot did not move the arm enough: {error}")
    raise ExperimentError(
        f"No safe pilot could be identified ({reason}). Say more in [arm.prior], so that a larger one is safe, or give "
        "peak_torque yourself with pilot = false."
    )


def pilot_config(config: Config) -> Config:
    """Half the period where the band allows it, no held-out multisine."""
    experiment = config.experiment
    update: dict[str, Any] = {"held_out": False, "peak_torque": None}
    if experiment.band is not None:
        samples = round(experiment.samples * _PILOT_PERIOD_SHARE)
        period = samples / experiment.rate
        low, high = experiment.band
        update |= {"period": period, "band": [max(low, 1 / period), high]}
    return config.model_copy(update={"experiment": experiment.model_copy(update=update)})


def _estimate(
    config: Config, folder: RunFolder, played: Plan, step: Step, starts: list[dict[str, float]]
) -> SettledResult:
    """Estimate the run in `folder`, started from `starts` too; once more where the arm found does not move as it did.

    A fit may end with friction so odd that it leaves the settled motion alone and holds the arm at rest. The second
    time it starts from what was found, with the friction of `starts`.
    """
    folder.write_starts(starts)
    result = estimate_run(folder)
    if _astray(config, nominal(result), played, step) > REPLAYED:
        shape = {name: value for name, value in starts[0].items() if name.startswith(_SHAPE)}
        folder.write_starts([{**result.values, **shape}])
        result = estimate_run(folder)
    return result


def next_amplitude(config: Config, result: SettledResult, played: Plan, step: Step) -> Amplitude:
    """As far as what `result` of `step`, in which `played` was, leaves open allows. Raises NoSafeTorque."""
    arm = nominal(result)
    astray = _astray(config, arm, played, step)
    if astray > REPLAYED:
        raise NoSafeTorque(
            f"The identified arm does not replay the motion that it was identified from: a peak is off by "
            f"{100 * astray:.0f} % of the way to its limit."
        )
    ensemble = result_ensemble(result, RESULT_ARMS, _farther(config, step))
    optimal = config.experiment.design == "optimal"
    plan = designed_plan(config, arm, list(result.parameters)) if optimal else roomy_plan(config, arm)
    return largest_amplitude(config, ensemble, plan=plan)


def _astray(config: Config, arm: Physics, played: Plan, step: Step) -> float:
    """How far the worst peak of `arm`, simulated from rest, is from that seen, as a share of the way to its limit."""
    alone = Ensemble((arm,), np.ones((1, len(config.joints))), "result")
    prediction = predict(config, played, alone)
    way = prediction.limits - prediction.origin
    off = np.abs((prediction.values[0] - step.seen) / way)[:GUARDED]
    return float(np.nan_to_num(off, nan=np.inf).max())


def _farther(config: Config, step: Step) -> float:
    """How many times farther the limits allow to go than this step went, the joint with most room."""
    allowed = np.ptp(np.array([joint.position_limit for joint in config.joints]), axis=1)
    return float((allowed / np.maximum(step.seen[1] - step.seen[0], 1e-3)).max())


def _typical_share(found: Amplitude) -> float:
    shares = np.median(found.prediction.shares, axis=0)[:GUARDED]
    return float(shares.max(axis=0).min())


def _play(
    config: Config,
    folder: RunFolder,
    shown_path: Path,
    watch: Watch,
    say: Say,
    name: str,
    found: Amplitude,
    steps: list[Step],
) -> str:
    """Run one step, compare, tell."""
    torque = run_experiment(config, folder, shown_path, watch, found.plan)
    samples = load_samples(folder.samples_path, len(config.joints))
    seen = peaks_of(config, samples["position"].T, samples["velocity"].T, samples["goal_current"].T)
    step = Step(name, found.peak_torque, found.prediction.median, found.prediction.quantile, seen)
    steps.append(step)
    say(str(step))
    if not step.within:
        say(f"{name}: more was seen than 99 % of the simulated arms reach; the arm is not quite what was assumed.")
    return torque


def _with_torque(config: Config, peak_torque: Array) -> Config:
    experiment = config.experiment.model_copy(update={"peak_torque": peak_torque.tolist()})
    return config.model_copy(update={"experiment": experiment})


def _without_held_out(config: Config) -> Config:
    return config.model_copy(update={"experiment": config.experiment.model_copy(update={"held_out": False})})


def _list(values: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
