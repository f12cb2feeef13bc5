"""`hil calibrate`: each joint's torque constant from two runs, one of them with a known mass bolted on."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimation.chain_calibrate import calibrate_chain_runs, link_of
from hil.estimation.model_from_config import voltage_driven, wanted_model
from hil.estimation.settled_period import settled_period
from hil.estimator.arrays import Array
from hil.estimator.calibration import Calibration, KnownMass, calibrate
from hil.estimator.chain.calibration import ChainCalibration, MassOnLink
from hil.estimator.identify import identify
from hil.plan.plan import IDENTIFY
from hil.results.json_form import Spread
from hil.results.parts import PerJoint
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

SCHEMA = 1

_CONTRADICTORY = 4.0
"""The runs contradict the mass if the joint fit's residual exceeds one step and, by this factor, that of a fit to the
run without the mass alone. For spatial arms, the factor applies to the residual relative to the noise.
"""

_IMPLAUSIBLE = 3.0
"""Ratio of an identified to the assumed torque constant, or its inverse, that cannot be due to the servo: published
values differ by a third. Without the mass, the two runs are alike, which an arm with endless torque would explain.
"""


@dataclass(frozen=True)
class TorqueConstant:
    """Identified and assumed torque of a joint per unit of goal, in `unit`: N m/A, or N m/V in pwm mode."""

    value: float
    std: Spread
    supposed: float
    unit: str


@dataclass(frozen=True)
class Estimated:
    """A parameter with its standard error [SI]."""

    value: float
    std: Spread


@dataclass(frozen=True)
class CalibrationFit:
    """Quality of the fit.

    residual_rms_ticks: RMS residual of both runs [encoder steps]. misfit: weighted sum of squared residuals per sample;
    1 means noise alone. joints: number of joints. reached: whether the fit has reached its minimum. alone_rms_ticks:
    RMS residual of a fit to the run without the mass alone [encoder steps]; None for spatial arms.
    """

    residual_rms_ticks: tuple[PerJoint, ...]
    misfit: float
    joints: int
    reached: bool = True
    alone_rms_ticks: PerJoint | None = None


@dataclass(frozen=True)
class CalibrationResult:
    """The result of `hil calibrate`: torque constants by joint name, and the arm's parameters estimated along with
    them.

    contradictory: whether the two runs do not differ as those of an arm without and with this mass would.
    """

    schema: int
    torque_per_goal: Mapping[str, TorqueConstant]
    parameters: Mapping[str, Estimated]
    fit: CalibrationFit
    contradictory: bool


@dataclass(frozen=True)
class AddedMass:
    """The mass as specified by the user: `distance` and `length` for a planar arm, `at` and `joint` for a spatial one.

    mass [kg], inertia about its centre of mass [kg m^2]. distance: distance from the last joint [m]; length: length of
    link 1 [m]. at: position [m] in the frame of the link that `joint` (by default the last joint) moves.
    """

    mass: float
    inertia: float = 0.0
    distance: float | None = None
    length: float | None = None
    at: tuple[float, float, float] | None = None
    joint: str | None = None


def calibrate_runs(without: RunFolder, with_mass: RunFolder, added: AddedMass) -> CalibrationResult:
    """Estimate the torque constants from runs without and with the added mass; see `hil.estimator.calibration`. Raises
    HilError, EstimationError.
    """
    config, other = without.load_config(), with_mass.load_config()
    _same_arm(config, other)
    if config.is_chain:
        if added.at is None or added.distance is not None or added.length is not None:
            raise ConfigError(
                "for a spatial arm, give the position of the mass in its link's frame, --at X Y Z in metres (and "
                "--joint NAME if it is not on the last link), instead of --distance and --length."
            )
        mass = MassOnLink(added.mass, added.at, link_of(config, added.joint), added.inertia)
        return _described_chain(config, calibrate_chain_runs((without, with_mass), (config, other), mass))
    if added.distance is None or added.at is not None or added.joint is not None:
        raise ConfigError(
            "for a planar arm, give --distance (from the last joint to the mass) instead of --at and --joint."
        )
    length = added.length
    if length is None and config.known is not None and config.known.length_1 is not None:
        length = config.known.quantities()["length_1"].value
    known = KnownMass(added.mass, added.distance, added.inertia, length or 0.0)
    if config.arm.gravity == 0.0:
        raise ConfigError("arm.gravity = 0: gravity does not act on the mass; calibrate in a vertical plane.")
    periods = [
        settled_period(each, run.load_facts(), load_samples(run.samples_path, len(each.joints)), IDENTIFY)
        for each, run in ((config, without), (other, with_mass))
    ]
    # The known mass determines every torque constant, so a torque_scale would be redundant.
    model = wanted_model(config.model, len(config.joints), voltage_driven(config)).without("torque_scale")
    first = identify(periods[0], model)
    found = calibrate(periods[0], periods[1], first, known, config.arm.gravity)
    alone = np.sqrt(np.nanmean(np.square(first.residual), axis=1)) / periods[0].position_step
    return _described(config, found, tuple(alone.tolist()))


def _same_arm(config: Config, other: Config) -> None:
    if len(config.joints) != len(other.joints):
        raise ConfigError(f"one run has {len(config.joints)} joints and the other {len(other.joints)}.")
    for one, two in zip(config.joints, other.joints, strict=True):
        if one.torque_per_goal != two.torque_per_goal:
            raise ConfigError(
                f"joint {one.name!r}: one run assumes {one.torque_per_goal:g} N m per unit of goal, the other "
                f"{two.torque_per_goal:g}; record both with the same TOML file."
            )


def _constants(config: Config, factor: list[float], std: list[float]) -> dict[str, TorqueConstant]:
    return {
        joint.name: TorqueConstant(
            value=joint.torque_per_goal * factor[i],
            std=joint.torque_per_goal * std[i],
            supposed=joint.torque_per_goal,
            unit=f"N m/{'V' if joint.drive_mode.name == 'PWM' else 'A'}",
        )
        for i, joint in enumerate(config.joints)
    }


def _contradicts(fit: CalibrationFit, factor: Array) -> bool:
    if np.any(np.abs(np.log(factor)) > np.log(_IMPLAUSIBLE)):
        return True
    if fit.alone_rms_ticks is None:
        return fit.misfit > _CONTRADICTORY**2
    return float(np.max(fit.residual_rms_ticks)) > max(1.0, _CONTRADICTORY * max(fit.alone_rms_ticks))


def _described_chain(config: Config, found: ChainCalibration) -> CalibrationResult:
    names = found.estimate.model.linear_names
    fit = CalibrationFit(
        residual_rms_ticks=tuple(map(tuple, found.residual_steps.tolist())),
        misfit=found.misfit,
        joints=len(config.joints),
        reached=found.estimate.reached,
    )
    return CalibrationResult(
        schema=SCHEMA,
        torque_per_goal=_constants(config, found.factor.tolist(), found.factor_std.tolist()),
        parameters={
            name: Estimated(float(value), float(error))
            for name, value, error in zip(names, found.value, found.std, strict=True)
        },
        fit=fit,
        contradictory=_contradicts(fit, found.factor),
    )


def _described(config: Config, found: Calibration, alone: PerJoint) -> CalibrationResult:
    fit = CalibrationFit(
        residual_rms_ticks=tuple(map(tuple, found.residual_steps.tolist())),
        misfit=found.misfit,
        joints=len(config.joints),
        alone_rms_ticks=alone,
    )
    return CalibrationResult(
        schema=SCHEMA,
        torque_per_goal=_constants(config, found.factor.tolist(), found.factor_std.tolist()),
        parameters={
            name: Estimated(float(value), float(error))
            for name, value, error in zip(found.names, found.value, found.std, strict=True)
        },
        fit=fit,
        contradictory=_contradicts(fit, found.factor),
    )


def calibration_lines(result: CalibrationResult) -> list[str]:
    """The torque constants as text, with instructions for the TOML file."""
    lines = []
    for name, found in result.torque_per_goal.items():
        lines.append(
            f"{name}: {found.value:.4f} +- {found.std:.4f} {found.unit} "
            f"({100 * (found.value / found.supposed - 1):+.1f} % from the assumed {found.supposed:g})"
        )
    worst = float(np.max(result.fit.residual_rms_ticks))
    lines.append(f"Largest residual in either run: {worst:.3f} encoder steps RMS; rounding alone gives 0.289.")
    if not result.fit.reached:
        lines.append(
            "The fit stopped short of its minimum; the standard errors include the remaining distance to the minimum. "
            "Record both runs again before relying on these values, with faster motion if a joint sticks."
        )
    if result.contradictory:
        lines.append(
            "Do not use these values: the two runs do not differ as this mass would make them differ. Check that the "
            "mass was bolted on in the second run only, that the folders are given in this order, and the mass, its "
            "position and the length of link 1; then record both runs again."
        )
        return lines
    lines.append("The standard errors cover noise only: add the relative errors of the mass and of its distance.")
    lines.append("Set torque_constant (torque_per_volt in pwm mode) of each joint to these values and estimate again.")
    return lines
