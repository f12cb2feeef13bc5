"""`hil calibrate` for spatial arms: every joint's torque constant from two runs, one with a known mass on a link."""

from dataclasses import replace

from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimation.chain_estimate import wanted_chain_model
from hil.estimation.settled_period import settled_period
from hil.estimator.chain.calibration import ChainCalibration, MassOnLink, calibrate_chain
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.plan.chain_model import known_chain
from hil.plan.plan import IDENTIFY
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder


def link_of(config: Config, joint: str | None) -> int:
    """Index, from 0, of the joint that moves the link with the mass; by default, the last joint. Raises ConfigError."""
    names = [each.name for each in config.joints]
    if joint is None:
        return len(names) - 1
    if joint not in names:
        raise ConfigError(f"--joint {joint}: the arm's joints are {', '.join(names)}.")
    return names.index(joint)


def calibrate_chain_runs(
    runs: tuple[RunFolder, RunFolder], configs: tuple[Config, Config], mass: MassOnLink
) -> ChainCalibration:
    """Estimate the torque constants from the runs without and with the mass. Raises HilError, EstimationError."""
    periods = [
        settled_period(config, run.load_facts(), load_samples(run.samples_path, len(config.joints)), IDENTIFY)
        for config, run in zip(configs, runs, strict=True)
    ]
    known = known_chain(configs[0])
    _check_same_geometry(known.base, known_chain(configs[1]).base)
    several = len(configs[0].joints) > 1
    model = replace(wanted_chain_model(configs[0], known), torque_scale=several, added_mass=True)
    # The calibration checks the configured torque constants, so they are not used as a prior.
    return calibrate_chain(periods[0], periods[1], model, replace(known.prior, scale_precision=None), mass)


def _check_same_geometry(one: BaseParameters, other: BaseParameters) -> None:
    for mine, its in zip(one.chain.arrays, other.chain.arrays, strict=True):
        if mine.shape != its.shape or abs(mine - its).max() > 1e-9:
            raise ConfigError("the runs' URDFs or bases differ: record both with the same TOML file and URDF.")
