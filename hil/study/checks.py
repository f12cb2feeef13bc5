"""Checks performed on a study before anything runs."""

import shutil
from pathlib import Path

import tomli_w

from hil.config.schema import Config, parse_config
from hil.errors import ConfigError
from hil.study.draw import arm_path, arm_values, drawn, put, run_count
from hil.study.schema import ON_ARM, Study

BYTES_A_ROW = 4_000
"""Generous estimate of the Parquet size of one row [bytes], for about a hundred columns."""

_SAMPLE_BYTES = 256
_REPORT_BYTES = 1_500_000
_LOOKED_AT = 32
"""Number of runs that are checked in advance by inserting their values into the arm's file; they are spread over the
study.
"""


def check_study(study: Study, out: Path) -> int:
    """Check a study; return its number of runs. Raises ConfigError for an unknown field, an invalid value, or
    insufficient disk space.
    """
    runs = run_count(study)
    if study.study.task in ON_ARM:
        step = max(1, runs // _LOOKED_AT)
        for run in range(0, runs, step):
            config = checked_arm(study, run)
            _check_fake(study, config)
        needed = runs * (BYTES_A_ROW + (_folder_bytes(config) if study.keep.run_folders else 0))
    else:
        if study.vary and study.study.task == "empty" and study.study.config is not None:
            arm_toml(study, 0)
        needed = runs * BYTES_A_ROW
    free = shutil.disk_usage(_existing(out)).free
    if needed > free:
        raise ConfigError(
            f"{study.path}: {runs} runs would write about {needed / 1e9:.3g} GB, but {out} has only {free / 1e9:.3g} "
            "GB free: set keep.run_folders = false, or name another folder with --out."
        )
    return runs


def arm_toml(study: Study, run: int) -> str:
    """The arm's file with the values of this run. Raises ConfigError for a key that does not exist."""
    if study.study.config is None:
        return ""
    values = arm_values(study)
    for key, value in drawn(study, run).items():
        try:
            put(values, key, value)
        except KeyError as error:
            raise ConfigError(
                f'{study.path}: vary."{key}": {arm_path(study).name} has no {error.args[0]!r} there. Use the keys of '
                'the arm\'s TOML, with list entries numbered from 0, as in "fake.arm.drives.0.coulomb".'
            ) from None
    return tomli_w.dumps(values)


def checked_arm(study: Study, run: int) -> Config:
    """The arm's configuration for this run. Raises ConfigError; its message gives the run and its values."""
    try:
        return parse_config(arm_toml(study, run), arm_path(study))
    except ConfigError as error:
        said = ", ".join(f"{key} = {value!r}" for key, value in drawn(study, run).items())
        raise ConfigError(f"{study.path}: run {run} ({said}) is not a valid arm: {error}") from error


def _check_fake(study: Study, config: Config) -> None:
    """Raise ConfigError for a real arm, which several workers would move at once, unattended."""
    if study.study.task != "dry_run" and not config.url.startswith("fake://"):
        raise ConfigError(
            f'{study.path}: study.config: {arm_path(study).name} has port.url = "{config.port.url}", and a study never '
            'moves a real arm. Set port.url = "fake://", or record its runs one by one and use task = "estimate".'
        )
    if study.study.task == "fault" and config.experiment.pilot:
        raise ConfigError(f'{study.path}: task = "fault" runs a single experiment: set experiment.pilot = false.')


def _folder_bytes(config: Config) -> int:
    experiment = config.experiment
    played = (
        experiment.period * (experiment.periods + experiment.max_settling_periods) * (2 if experiment.held_out else 1)
    )
    return int(played * experiment.rate) * _SAMPLE_BYTES * (3 if experiment.pilot else 1) + _REPORT_BYTES


def _existing(path: Path) -> Path:
    for place in (path.absolute(), *path.absolute().parents):
        if place.exists():
            return place
    return Path("/")
