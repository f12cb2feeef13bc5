"""Identification of randomly drawn arms without manual help, starting from the file that `hil init` writes.

    python benchmarks/population.py [--arms N | --seeds A..B] [--quick] [--others] [--jobs N] [--json] [--keep DIR]

The distribution is described in benchmarks/drawn_arms/population_arms.py, with --others in population_others.py next to
it. Each arm is identified by `hil identify` in a separate process, in virtual time, and its result is compared
with the true parameters of the fake arm. --quick: friction = "stribeck" instead of "auto" and half the rate, for tests.

finished              share that ended with a result
beyond_limit          arms that overshot a position limit by more than hil.dry_run.stopping_distance predicts
yes, yes_current, yes_pwm   share with the verdict "yes": of all arms, of those with current sensors, and of those that
                      are voltage-driven
yes_but_wrong         share of the "yes" verdicts with an inertia, gravity or friction parameter that is off by more
                      than 2 % and by more than 3 standard errors. All torques are in units of the first joint's torque
                      constant; warming friction is evaluated in the middle of the fitted periods
worst_percent_of_yes  largest such error of an arm with the verdict "yes" [%]
held_out_percent      largest and median held-out prediction error of these arms [% of motion RMS]; where friction has
                      changed, one factor per joint is fitted to the held-out motion
held_out_as_fitted_percent   the same without this factor, i.e. with friction as in the fitted motion
cpu_seconds_*         processor time of the whole process
arm_seconds_median    time for which the arm was driven
"""

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.drawn_arms.population_arms import DrawnArm, draw
from benchmarks.drawn_arms.population_others import draw as draw_other
from benchmarks.machine import machine
from hil.config.schema import Config, parse_config
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.stopping_distance import beyond_when_passed
from hil.estimation.truth import true_parameters
from hil.estimator.arrays import Array
from hil.fakes.plants.arm import base_parameters
from hil.plan.plan import make_plan
from hil.runs.recording import Phase, load_samples
from hil.study.jobs import each

FINISHED_WITHIN_S = 900.0
JUDGED = ("inertia", "coupling", "armature", "gravity", "viscous", "coulomb")
TOLERANCE, DEVIATIONS = 0.02, 3.0
NOTHING = 1e-9  # N m


@dataclass(frozen=True)
class Outcome:
    """The outcome for one arm. errors: each judged parameter's relative error, and its error in standard errors."""

    seed: int
    name: str
    has_current: bool
    finished: bool
    message: str
    cpu_seconds: float
    arm_seconds: float
    steps: int
    beyond: float
    beyond_predicted: float
    trust: str = ""
    held_out: float = 0.0
    held_out_as_fitted: float = 0.0
    residual: float = 0.0
    model: str = ""
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def wrong(self) -> dict[str, tuple[float, float]]:
        """Parameters whose errors exceed both the relative bound and the bound in standard errors."""
        return {n: e for n, e in self.errors.items() if abs(e[0]) > TOLERANCE and not abs(e[1]) <= DEVIATIONS}

    def __str__(self) -> str:
        head = f"{self.seed:5d} {self.name:44s} cpu {self.cpu_seconds:6.1f} s, arm {self.arm_seconds:5.0f} s"
        head += f" in {self.steps}"
        passed = f"  BEYOND by {self.beyond:.3f}, {self.beyond_predicted:.3f} predicted" if self.beyond else ""
        if not self.finished:
            return f"{head}{passed}  FAILED: {self.message}"
        worst = max(self.errors, key=lambda name: abs(self.errors[name][0]))
        off = f"worst {worst} {100 * self.errors[worst][0]:+.2f} % {self.errors[worst][1]:+.1f} std"
        wrong = "".join(f" WRONG {n} {100 * e[0]:+.1f} % {e[1]:+.1f} std" for n, e in self.wrong.items())
        return (
            f"{head}{passed}  {self.trust}: {off}, held out {100 * self.held_out:.2f} %, {self.residual:.2f} ticks, "
            f"{self.model}{wrong}"
        )


def run(seed: int, folder: Path, *, quick: bool = False, others: bool = False) -> Outcome:
    """Identify the arm for this seed in a separate process, and judge the outcome."""
    arm = draw_other(seed) if others else draw(seed)
    if quick:
        arm = replace(arm, toml=_quicker(arm.toml))
    return outcome_of(seed, arm, folder)


def outcome_of(seed: int, arm: DrawnArm, folder: Path) -> Outcome:
    """Identify this arm in a separate process, and judge the outcome."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "arm.toml"
    path.write_text(arm.toml, encoding="utf-8")
    result, message, seconds = _identify(path, folder)
    config = parse_config(arm.toml, path)
    arm_seconds, steps, beyond, predicted = _motion(config, folder / "run")
    outcome = Outcome(
        seed, arm.name, arm.has_current, result is not None, message, seconds, arm_seconds, steps, beyond, predicted
    )
    return outcome if result is None else _judged(outcome, arm, config, result, folder / "run")


def _quicker(toml: str) -> str:
    """Return the file with a fixed friction model and half the rate, which halves the fake bus's computing time."""
    rate = re.search(r"^rate = ([0-9.]+)", toml, re.MULTILINE)
    assert rate is not None and 'friction = "auto"  ' in toml
    slower = f"rate = {0.5 * float(rate[1]):g}"
    return toml.replace(rate[0], slower, 1).replace('friction = "auto"  ', 'friction = "stribeck"')


def _identify(path: Path, folder: Path) -> tuple[dict[str, Any] | None, str, float]:
    """The result or an error message, and the processor time [s]."""
    command = [sys.executable, "-m", "hil", "identify", str(path), "--out", str(folder / "run"), "--json"]
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "out.json").open("w") as out, (folder / "said.txt").open("w") as said:
        actions = [(os.POSIX_SPAWN_DUP2, out.fileno(), 1), (os.POSIX_SPAWN_DUP2, said.fileno(), 2)]
        child = os.posix_spawn(sys.executable, command, quiet, file_actions=actions)
        began = time.monotonic()
        while True:
            ended, status, used = os.wait4(child, os.WNOHANG)
            if ended:
                break
            if time.monotonic() - began > FINISHED_WITHIN_S:
                os.kill(child, 9)
            time.sleep(0.1)
    seconds = used.ru_utime + used.ru_stime
    message = (folder / "said.txt").read_text(encoding="utf-8").strip()
    if os.waitstatus_to_exitcode(status):
        return None, " | ".join(message.splitlines()[-3:]) or f"killed after {FINISHED_WITHIN_S:g} s", seconds
    return json.loads((folder / "out.json").read_text(encoding="utf-8")), "", seconds


def _motion(config: Config, folder: Path) -> tuple[float, int, float, float]:
    """Time for which the arm was driven [s], number of runs, largest overshoot of a limit, and its prediction [rad]."""
    seconds, steps, beyond, predicted = 0.0, 0, 0.0, 0.0
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    for path in sorted(folder.rglob("samples.npy")):
        samples = load_samples(path, len(config.joints))
        steps += 1
        seconds += len(samples) / config.experiment.rate
        position = samples["position"]
        if not len(position):
            continue
        passed = np.nan_to_num(np.maximum(low - position, position - high), nan=-1.0)
        if passed.max() > beyond:
            beyond = float(passed.max())
            row = int(np.unravel_index(np.argmax(passed > 0), passed.shape)[0])
            predicted = _predicted(config, samples[row])
    return seconds, steps, beyond, predicted


def _predicted(config: Config, at: np.void) -> float:
    """Predicted overshoot beyond a limit if the arm is stopped at this sample [rad]."""
    most = [0.97 * joint.goal_limit * joint.torque_per_goal for joint in config.joints]
    experiment = config.experiment.model_copy(update={"peak_torque": most})
    plan = make_plan(config.model_copy(update={"experiment": experiment}))
    ways = beyond_when_passed(config, plan, prior_ensemble(config, 16), np.abs(at["velocity"]), at["position"])
    return float(max(far.max() for far in ways.values()))


def _truth(config: Config, folder: Path) -> dict[str, float]:
    """True parameters in the middle of the fitted periods, since friction falls while grease warms."""
    truth = true_parameters(config)
    assert truth is not None and config.fake is not None
    samples = load_samples(folder / "samples.npy", len(config.joints))
    phase, segment, period = (samples[name].astype(np.int64) for name in ("phase", "segment", "period"))
    written: Array = samples["time_before_write"]
    played = (phase == Phase.PERIODIC) & (segment == 0)
    # Only the last periods of the multisine are fitted, once the motion has settled.
    fitted = played & (period > period[played].max() - config.experiment.periods)
    now = base_parameters(config.fake.arm, float(np.median(written[fitted])))
    warm = base_parameters(config.fake.arm)
    return {name: value + now[name] - warm[name] for name, value in truth.items()}


def _judged(outcome: Outcome, arm: DrawnArm, config: Config, result: dict[str, Any], folder: Path) -> Outcome:
    truth = _truth(config, folder)
    friction = min(value for name, value in truth.items() if name.startswith("coulomb"))
    errors = {}
    for name, entry in result["parameters"].items():
        if not name.startswith(JUDGED):
            continue
        true = truth[name] * arm.units
        # The true gravity terms of a horizontal arm are zero, so their errors are divided by friction instead.
        size = abs(true) if abs(true) > NOTHING else arm.units * friction
        error = entry["value"] - true
        std = entry["std"]
        errors[name] = (error / size, error / std if std else np.inf)
    return Outcome(
        **{
            **{name: getattr(outcome, name) for name in outcome.__dataclass_fields__},
            "trust": result["verdict"]["trust"],
            "held_out": max(result["validation"].get("held_out_rms", [np.nan])),
            "held_out_as_fitted": max(
                result["validation"].get("held_out_as_fitted_rms") or result["validation"].get("held_out_rms", [np.nan])
            ),
            "residual": max(result["fit"]["residual_rms_ticks"]),
            "model": result["fit"]["model"],
            "errors": errors,
        }
    )


def figures(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return the figures to print."""
    yes = [each for each in outcomes if each.trust == "yes"]

    def share(of: list[Outcome]) -> float | None:
        return sum(each.trust == "yes" for each in of) / len(of) if of else None

    cpu = [each.cpu_seconds for each in outcomes]
    return {
        "arms": len(outcomes),
        "finished": sum(each.finished for each in outcomes) / len(outcomes),
        "beyond_limit": sum(each.beyond > each.beyond_predicted for each in outcomes),
        "yes": share(outcomes),
        "yes_current": share([each for each in outcomes if each.has_current]),
        "yes_pwm": share([each for each in outcomes if not each.has_current]),
        "yes_but_wrong": sum(bool(each.wrong) for each in yes) / max(1, len(yes)),
        "worst_percent_of_yes": max((100 * abs(e[0]) for each in yes for e in each.wrong.values()), default=0.0),
        "held_out_percent": max((100 * each.held_out for each in yes), default=None),
        "held_out_percent_median": float(np.median([100 * each.held_out for each in yes])) if yes else None,
        "held_out_as_fitted_percent": max((100 * each.held_out_as_fitted for each in yes), default=None),
        "held_out_as_fitted_percent_median": float(np.median([100 * each.held_out_as_fitted for each in yes]))
        if yes
        else None,
        "cpu_seconds_median": float(np.median(cpu)),
        "cpu_seconds_p95": float(np.quantile(cpu, 0.95)),
        "arm_seconds_median": float(np.median([each.arm_seconds for each in outcomes])),
        "verdicts": dict(Counter(each.trust or "not finished" for each in outcomes)),
        "failures": {each.seed: each.message for each in outcomes if not each.finished},
    }


def study(
    seeds: list[int], jobs: int, keep: Path | None, tell: Any = None, *, quick: bool = False, others: bool = False
) -> list[Outcome]:
    """Identify the arm for each seed. tell: function called with each outcome."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = (keep or Path(temporary)).absolute()
        return each(partial(_run_in, folder, quick, others), seeds, count=jobs, tell=tell or (lambda _: None))


def _run_in(folder: Path, quick: bool, others: bool, seed: int) -> Outcome:
    return run(seed, folder / str(seed), quick=quick, others=others)


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("..")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--arms", type=int, default=200)
    parser.add_argument("--seeds", type=_seeds, help="A..B, instead of --arms")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--others", action="store_true", help="draw from benchmarks/drawn_arms/population_others.py")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--keep", type=Path, help="folder for files, run folders and messages")
    options = parser.parse_args()
    seeds = options.seeds or list(range(1000, 1000 + options.arms))
    if not options.json:
        print(machine())
    stream = sys.stderr if options.json else sys.stdout
    outcomes = study(
        seeds,
        options.jobs,
        options.keep,
        lambda each: print(each, file=stream, flush=True),
        quick=options.quick,
        others=options.others,
    )
    measured = figures(outcomes)
    if options.json:
        print(json.dumps({**measured, "each": [asdict(each) for each in outcomes]}))
        return
    for name, value in measured.items():
        print(f"{name:24s} {value:.4g}" if isinstance(value, float) else f"{name:24s} {value}")


if __name__ == "__main__":
    main()
