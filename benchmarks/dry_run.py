"""Predictions of dry runs compared with the subsequent experiments, on realistic fake arms.

    python benchmarks/dry_run.py [--json] [--arms N] [--pilots N]

With --arms N, N arms are drawn from a prior with 30 % spread; each runs, in virtual time, the largest experiment that a
dry run with this prior allows. Then the arm of configs/first_time.toml is identified from joint limits and link lengths
only, with a pilot and a full run. With --pilots N, N - 1 more arms drawn from the prior are identified in the same way.

within_quantile       share of arms whose measured peaks are all within the predicted 99 % quantiles
limit_touched         number of arms that the guard had to stop
range_used            share of the position range used by the full run's worse joint; smallest value of all pilot arms
std_ratio_pilot_full  worst relative standard error (offsets relative to dry friction) after the pilot, divided by that
                      after the full run; smallest value of all pilot arms
std_ratio_least       the same ratio for each single parameter; smallest value of all parameters and pilot arms
predicted_over_seen   largest relative deviation of a measured peak from the prediction after the pilot
worst_std_ratio       worst relative standard error with the designed multisine, divided by that with a plain multisine
                      of the same limits and duration
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.machine import machine
from hil.config.schema import Config, parse_config
from hil.dry_run.amplitude import with_peaks
from hil.dry_run.waves import design_problem
from hil.errors import SafetyStop
from hil.estimation.settled_estimate import estimate_run
from hil.pilot import identify_in_steps
from hil.results.result import SettledResult
from hil.runs.run_folder import RunFolder
from hil.study.jobs import each
from tests.support.dry_runs import drawn_arm, fake_of, prior_study, study_config, worst_relative_std

CONFIGS = Path(__file__).parents[1] / "configs"


def pilot_study(pilots: int, seed: int = 2, jobs: int | None = None) -> dict[str, Any]:
    """Identify arms drawn from the prior, starting from joint limits and link lengths only."""
    plain = parse_config((CONFIGS / "first_time.toml").read_text(encoding="utf-8"), CONFIGS / "first_time.toml")
    random = np.random.default_rng((seed, 22))
    drawn = [plain.model_copy(update={"fake": drawn_arm(study_config(), random).fake}) for _ in range(pilots - 1)]
    done = each(_pilot, [plain, *drawn][:pilots], count=jobs)
    found = [outcome for outcome in done if outcome is not None]
    used, ratios, least, distances = zip(*found, strict=True) if found else ((), (), (), ())
    return {
        "pilots": pilots,
        "pilot_limit_touched": len(done) - len(found),
        "range_used": min(used, default=0.0),
        "std_ratio_pilot_full": min(ratios, default=0.0),
        "std_ratio_least": min(least, default=0.0),
        "predicted_over_seen": max(distances, default=1.0),
    }


def _pilot(config: Config) -> tuple[float, float, float, float] | None:
    """Range used, ratios of standard deviations, and prediction error for one arm; None if the arm was stopped."""
    with fake_of(config) as (drawn, folder):
        run = RunFolder.create(folder / "run", drawn)
        try:
            _, result = identify_in_steps(drawn, run, drawn.path, lambda _: None, lambda _: None)
        except SafetyStop:
            return None
        pilot = first_estimate(folder / "run")
    assert result.steps is not None
    seen, median = map(np.array, (result.steps[-1].seen, result.steps[-1].predicted_median))
    allowed = np.ptp(np.array([joint.position_limit for joint in config.joints]), axis=1)
    rest = np.array(config.arm.rest_pose)
    moved = np.stack((seen[0] - rest, seen[1] - rest, seen[2]))
    foreseen = np.stack((median[0] - rest, median[1] - rest, median[2]))
    return (
        float(((seen[1] - seen[0]) / allowed).min()),
        worst_relative_std(pilot) / worst_relative_std(result),
        min(pilot.parameters[n].std / e.std for n, e in result.parameters.items()),
        float(np.abs(foreseen / moved - 1).max()),
    )


def first_estimate(run: Path) -> SettledResult:
    """Estimate from the last pilot run, which is the first in which every joint moved."""
    last = sorted(run.glob("pilot-*"), key=lambda path: int(path.name.removeprefix("pilot-")))[-1]
    return estimate_run(RunFolder.open(last))


def design_study(seeds: int = 2) -> dict[str, Any]:
    """Compare designed and plain multisines, both scaled to the same limits, on the nominal model of the true arm."""
    from hil.estimator.excitation.optimal_design import design_optimal
    from hil.estimator.models.parameters import Physics
    from hil.fakes.plants.arm import base_parameters

    config = parse_config((CONFIGS / "first_time.toml").read_text(encoding="utf-8"), CONFIGS / "first_time.toml")
    assert config.fake is not None
    known = base_parameters(config.fake.arm)
    extra = {f"{term}_{joint}": value for joint in (1, 2) for term, value in FRICTION.items()}
    problem = design_problem(config, Physics.of({**known, **extra, "lag": 1e-3}), tuple(known))
    seeded = [config.experiment.model_copy(update={"seed": seed}) for seed in range(1, seeds + 1)]
    plans = [with_peaks(config.model_copy(update={"experiment": each}), problem.limits.torque) for each in seeded]
    designs = [
        design_optimal(plan.segments[0].multisine, problem, experiment.seed)
        for plan, experiment in zip(plans, seeded, strict=True)
    ]
    return {"worst_std_ratio": max(design.worst / design.plain_worst for design in designs)}


FRICTION = {"coulomb_width": 0.01, "stribeck_rise": 0.4, "stribeck_velocity": 0.15}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--arms", type=int, default=200)
    parser.add_argument("--pilots", type=int, default=6)
    parser.add_argument("--jobs", type=int, help="workers; one per core unless given")
    options = parser.parse_args()
    measured = {
        **prior_study(options.arms, jobs=options.jobs),
        **pilot_study(options.pilots, jobs=options.jobs),
        **design_study(),
    }
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:22s} {value:.4g}")


if __name__ == "__main__":
    main()
