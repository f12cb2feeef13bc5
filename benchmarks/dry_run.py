"""Predictions of dry runs compared with the subsequent experiments, on realistic fake arms.

    python benchmarks/dry_run.py [--json] [--arms N] [--pilots N]

`--arms` arms are drawn from a prior with 30 % spread; each plays, in virtual time, the largest experiment that a dry
run of that prior allows. The arm of configs/first_time.toml is then identified from joint limits and link lengths
only, with pilot and full run; with --pilots N, so are N - 1 more arms drawn from the prior; the smallest value counts.

within_quantile       share of arms whose measured peaks all stay within the predicted 99 %
limit_touched         arms that the guard had to stop
range_used            share of the position range used by the full run's worse joint; smallest of the pilot arms
std_ratio_pilot_full  worst relative standard error (offsets relative to dry friction) of the pilot over the full run's;
                      smallest of the pilot arms
std_ratio_least       the same ratio per parameter, smallest of all
predicted_over_seen   after the pilot: largest relative deviation of a predicted from a measured peak
worst_std_ratio       designed over plain multisine, same limits and duration: worst relative standard error
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hil.config.schema import Config, parse_config
from hil.dry_run.amplitude import Amplitude, largest_amplitude, with_peaks
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.prediction import GUARDED, peaks_of
from hil.dry_run.prior import quantities
from hil.dry_run.waves import design_problem
from hil.errors import NotSettled, SafetyStop
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.pilot import identify_in_steps
from hil.results.result import Result, SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

CONFIGS = Path(__file__).parents[1] / "configs"
PRIOR = """[arm.prior]
spread = 0.3
rough_spread = 0.3
link_mass = [0.180, 0.200]
link_centre = [0.081, 0.112]
link_inertia = [7.0e-4, 2.9e-4]
servo_mass = [0.082, 0.082]
armature = [0.010, 0.010]
viscous = [0.045, 0.040]
coulomb = [0.055, 0.050]
"""
ARMS_IN_PRIOR = 192
"""Size of the predicting ensemble, which contains none of the arms that are run."""


def study_config() -> Config:
    """A short experiment on the realistic arm, with a prior of 30 % spread."""
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
    for old, new in (
        ("[experiment]\n", f"{PRIOR}\n[experiment]\nheld_out = false\nsettle_within = 0.2\n"),
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "period = 2.0 "),
        ("band = [0.1, 5.0]", "band = [0.5, 5.0]"),
        ("ramp = 1.0 ", "rest = 0.1\nramp = 0.5 "),
    ):
        assert old in text, old
        text = text.replace(old, new, 1)
    return parse_config(text, CONFIGS / "first_time.toml")


def drawn_arm(config: Config, random: np.random.Generator) -> Config:
    """The configuration with a fake arm drawn from its prior, torque constants included."""
    assert config.fake is not None and config.arm.link_lengths is not None
    drawn = {
        name: quantity.draw(random, 1)[0]
        for name, quantity in quantities(config, np.array(config.arm.link_lengths)).items()
    }
    arm = config.fake.arm
    links = tuple(
        link.model_copy(
            update={
                "mass": float(drawn["link_mass"][i]),
                "centre": float(drawn["link_centre"][i]),
                "inertia": float(drawn["link_inertia"][i]),
            }
        )
        for i, link in enumerate(arm.links)
    )
    drives = tuple(
        drive.model_copy(
            update={
                "mass": float(drawn["servo_mass"][i]),
                "rotor_inertia": float(drawn["armature"][i]) / drive.gear_ratio**2,
                "viscous": float(drawn["viscous"][i]),
                "coulomb": float(drawn["coulomb"][i]),
                "stribeck_rise": float(drawn["stribeck_rise"][i]),
                "torque_constant": drive.torque_constant * float(np.exp(0.083 * random.standard_normal())),
            }
        )
        for i, drive in enumerate(arm.drives)
    )
    changed = arm.model_copy(update={"links": links, "drives": drives})
    return config.model_copy(update={"fake": config.fake.model_copy(update={"arm": changed})})


def run_on(config: Config, found: Amplitude, folder: Path) -> np.ndarray | None:
    """Measured peaks (quantities, joints) of a run; None if the guard stopped the arm."""
    run = RunFolder.create(folder / "run", config)
    try:
        run_experiment(config, run, config.path, lambda _: None, found.plan)
    except SafetyStop:
        return None
    except NotSettled:
        pass  # an unusual arm; its peaks still count
    samples = load_samples(run.samples_path, len(config.joints))
    return peaks_of(config, samples["position"].T, samples["velocity"].T, samples["goal_current"].T)


def prior_study(arms: int, seed: int = 1) -> dict[str, Any]:
    """Play the largest safe experiment of one prior on arms drawn from it."""
    config = study_config()
    found = largest_amplitude(config, prior_ensemble(config, ARMS_IN_PRIOR))
    quantile = found.prediction.quantile
    random = np.random.default_rng((seed, 21))
    within = touched = 0
    for _ in range(arms):
        with fake_of(drawn_arm(config, random)) as (drawn, folder):
            seen = run_on(drawn, found, folder)
        touched += seen is None
        within += seen is not None and is_within(config, seen, quantile)
    return {"arms": arms, "within_quantile": within / arms, "limit_touched": touched}


def is_within(config: Config, seen: np.ndarray, quantile: np.ndarray) -> bool:
    """Whether all measured peaks stay within the predicted ones, up to one encoder step and one tick of velocity."""
    low, high, velocity = seen[:GUARDED]
    return bool(
        (low >= quantile[0] - 0.0016).all()
        and (high <= quantile[1] + 0.0016).all()
        and (velocity <= quantile[2] + 0.024).all()
    )


class fake_of:  # noqa: N801  (a context manager that reads like a function)
    """A separate configuration file for a drawn arm, because fake:// reads the arm from a file."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._folder = tempfile.TemporaryDirectory()

    def __enter__(self) -> tuple[Config, Path]:
        folder = Path(self._folder.name)
        path = folder / "arm.toml"
        path.write_text(with_fake(self._config), encoding="utf-8")
        return self._config.model_copy(update={"path": path}), folder

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def with_fake(config: Config) -> str:
    """The configuration's text with the numbers of its fake arm inserted."""
    text = config.path.read_text(encoding="utf-8")
    assert config.fake is not None
    head, _, _ = text.partition("[[fake.arm.links]]")
    arm = config.fake.arm
    lines = [head]
    for table, parts in (("links", arm.links), ("drives", arm.drives)):
        for part in parts:
            values = "\n".join(f"{k} = {v}" for k, v in part.model_dump(exclude_defaults=True).items() if v is not None)
            lines.append(f"[[fake.arm.{table}]]\n{values}\n")
    return "\n".join(lines)


def pilot_study(pilots: int, seed: int = 2) -> dict[str, Any]:
    """Identify arms drawn from the prior, starting from joint limits and link lengths only."""
    plain = parse_config((CONFIGS / "first_time.toml").read_text(encoding="utf-8"), CONFIGS / "first_time.toml")
    random = np.random.default_rng((seed, 22))
    used, ratios, least, distances, touched = [], [], [], [], 0
    for number in range(pilots):
        config = plain if number == 0 else plain.model_copy(update={"fake": drawn_arm(study_config(), random).fake})
        with fake_of(config) as (drawn, folder):
            run = RunFolder.create(folder / "run", drawn)
            try:
                _, result = identify_in_steps(drawn, run, drawn.path, lambda _: None, lambda _: None)
            except SafetyStop:
                touched += 1
                continue
            pilot = first_estimate(folder / "run")
        seen, median = map(np.array, (result.steps[-1].seen, result.steps[-1].predicted_median))
        allowed = np.ptp(np.array([joint.position_limit for joint in config.joints]), axis=1)
        used.append(float(((seen[1] - seen[0]) / allowed).min()))
        ratios.append(worst_relative_std(pilot) / worst_relative_std(result))
        least.append(min(pilot.parameters[n].std / e.std for n, e in result.parameters.items()))
        rest = np.array(config.arm.rest_pose)
        moved = np.stack((seen[0] - rest, seen[1] - rest, seen[2]))
        foreseen = np.stack((median[0] - rest, median[1] - rest, median[2]))
        distances.append(float(np.abs(foreseen / moved - 1).max()))
    return {
        "pilots": pilots,
        "pilot_limit_touched": touched,
        "range_used": min(used, default=0.0),
        "std_ratio_pilot_full": min(ratios, default=0.0),
        "std_ratio_least": min(least, default=0.0),
        "predicted_over_seen": max(distances, default=1.0),
    }


def first_estimate(run: Path) -> SettledResult:
    """Estimate from the last pilot, the first one in which every joint moved."""
    last = sorted(run.glob("pilot-*"), key=lambda path: int(path.name.removeprefix("pilot-")))[-1]
    return estimate_run(RunFolder.open(last))


def worst_relative_std(result: Result) -> float:
    """The largest relative standard error of the base parameters; offsets are related to the joint's dry friction."""
    entries = result.parameters
    against = {name: entries[name.replace("offset", "coulomb")].value for name in entries}
    return max(entry.std / abs(against[name]) for name, entry in entries.items())


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
    from machine import machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--arms", type=int, default=200)
    parser.add_argument("--pilots", type=int, default=6)
    options = parser.parse_args()
    measured = {**prior_study(options.arms), **pilot_study(options.pilots), **design_study()}
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:22s} {value:.4g}")


if __name__ == "__main__":
    main()
