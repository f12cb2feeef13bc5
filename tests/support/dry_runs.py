"""Dry runs of fake arms drawn from a prior, compared with the experiments; shared with benchmarks/dry_run.py."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.config.schema import Config, parse_config
from hil.dry_run.amplitude import Amplitude, largest_amplitude
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.prediction import GUARDED, peaks_of
from hil.dry_run.prior import quantities
from hil.errors import NotSettled, SafetyStop
from hil.experiment.run import run_experiment
from hil.results.result import Result
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from hil.study.jobs import each
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

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
    text = replaced(
        text,
        ("[experiment]\n", f"{PRIOR}\n[experiment]\nheld_out = false\nsettle_within = 0.2\n"),
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "period = 2.0 "),
        ("band = [0.1, 5.0]", "band = [0.5, 5.0]"),
        ("ramp = 1.0 ", "rest = 0.1\nramp = 0.5 "),
    )
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


def prior_study(arms: int, seed: int = 1, jobs: int | None = 0) -> dict[str, Any]:
    """Run the largest safe experiment of one prior on arms drawn from it; jobs: workers, 0 is this process."""
    config = study_config()
    found = largest_amplitude(config, prior_ensemble(config, ARMS_IN_PRIOR))
    quantile = found.prediction.quantile
    random = np.random.default_rng((seed, 21))
    peaks = each(partial(_seen_on, found), [drawn_arm(config, random) for _ in range(arms)], count=jobs)
    within = sum(seen is not None and is_within(config, seen, quantile) for seen in peaks)
    return {"arms": arms, "within_quantile": within / arms, "limit_touched": sum(seen is None for seen in peaks)}


def _seen_on(found: Amplitude, config: Config) -> np.ndarray | None:
    """Peaks of the experiment on the arm of this configuration; None if the guard stopped it."""
    with fake_of(config) as (drawn, folder):
        return run_on(drawn, found, folder)


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


def worst_relative_std(result: Result) -> float:
    """The largest relative standard error of the base parameters; offsets are related to the joint's dry friction."""
    entries = result.parameters
    against = {name: entries[name.replace("offset", "coulomb")].value for name in entries}
    return max(entry.std / abs(against[name]) for name, entry in entries.items())
