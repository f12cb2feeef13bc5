"""Conversion of an estimate from settled periods to a result (hil.results.result)."""

import math
from dataclasses import dataclass

from hil.arm_model import JointFacts
from hil.config.schema import Config
from hil.estimation.truth import scaled, true_parameters
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.fitted_parameters import FittedParameters
from hil.estimator.identify import Estimate
from hil.results.parts import ArmFacts, Covariance, ModelChoice, Quantity, RunTiming, SettledFit, Validation, Verdict
from hil.results.result import SettledResult

QUANTISATION_FLOOR_TICKS = 1 / math.sqrt(12)


@dataclass(frozen=True)
class Checks:
    """What the checks of an estimate have found."""

    validation: Validation
    verdict: Verdict
    warnings: tuple[str, ...]
    model_choice: ModelChoice | None


def make_result(
    config: Config,
    shown_path: str,
    period: SettledPeriod,
    estimate: Estimate,
    checks: Checks,
    timing: RunTiming,
    mean_time: float,
) -> SettledResult:
    """Build the result of one run; `mean_time` is the mean time of the period's samples on the port's clock [s]."""
    base = len(estimate.model.base_names)
    truth, extra = true_parameters(config, mean_time), quantities(estimate, base, len(estimate.names))
    return SettledResult(
        method=f"settled period, least squares on Fourier coefficients, then maximum likelihood; "
        f"{estimate.model.friction} friction, {estimate.model.drive} drive",
        config=shown_path,
        joints=len(config.joints),
        parameters=quantities(estimate, 0, base),
        extra=extra,
        covariance=Covariance(tuple(estimate.names), tuple(map(tuple, estimate.covariance.tolist()))),
        fit=SettledFit(
            residual_rms_ticks=tuple(estimate.residual_steps.tolist()),
            quantisation_floor_ticks=round(QUANTISATION_FLOOR_TICKS, 4),
            samples_per_period=period.position.shape[1],
            periods=period.periods,
            model=estimate.model.description,
            outliers=estimate.outliers,
            correlation_time=estimate.correlation_time,
        ),
        validation=checks.validation,
        verdict=checks.verdict,
        warnings=checks.warnings,
        model_choice=checks.model_choice,
        timing=timing,
        arm=arm_facts(config),
        truth=truth,
        truth_scaled=scaled(truth, config, extra),
    )


def arm_facts(config: Config) -> ArmFacts:
    """The part of the configuration that a model needs."""
    joints = tuple(
        JointFacts(
            name=joint.name,
            servo=joint.model,
            mode=joint.drive_mode.name.lower(),
            torque_per_goal=joint.torque_per_goal,
            torque_per_goal_std=joint.torque_per_goal_std,
            goal_limit=joint.goal_limit,
            position_limit=(joint.position_limit[0], joint.position_limit[1]),
            velocity_limit=joint.velocity_limit,
            servos=len(joint.ids),
        )
        for joint in config.joints
    )
    return ArmFacts(config.arm.gravity, tuple(config.arm.rest_pose), joints)


def quantities(estimate: FittedParameters, start: int, end: int) -> dict[str, Quantity]:
    """The parameters from index `start` up to `end`, by name."""
    return {
        estimate.names[index]: Quantity(float(estimate.value[index]), float(estimate.std[index]), estimate.units[index])
        for index in range(start, end)
    }
