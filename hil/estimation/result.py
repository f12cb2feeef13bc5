"""result.json: what an identification found, in one dictionary that a person and a program can read.

schema, method, config, joints
parameters   the base parameters: value, std (null on file where the recording shows nothing of it), unit
extra        what the model needed beside them (friction's shape, drive's lag): value, std, unit
covariance   of parameters and extra together, rows in the order of `names`
fit          residual of the settled period, in encoder steps, against the encoder's own rounding
validation   free prediction of another multisine and of this one, as fractions of the motion's RMS; residual against
             rounding, whiteness, conditioning; noise, distortion and model error in encoder steps
verdict      trust it or not, the weakest parameter, and why, in sentences
warnings     what looked wrong in the recording, in sentences
model_choice with friction = "auto": the models tried, the one chosen, what it gained and cost
timing       how the stream kept its ticks, and how long the estimation took
arm          what a model needs to be used: gravity, rest pose, and per joint name, servo, mode, limits, torque per
             goal [N m/A, or N m/V in pwm mode]
truth        only on a fake arm
"""

import math
from typing import Any

from hil.config.schema import Config
from hil.estimation.truth import true_parameters
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate

SCHEMA = 1
QUANTISATION_FLOOR_TICKS = 1 / math.sqrt(12)


def make_result(
    config: Config,
    shown_path: str,
    period: SettledPeriod,
    estimate: Estimate,
    checked: dict[str, Any],
    timing: dict[str, Any],
) -> dict[str, Any]:
    """The result of one run. checked: what the validation found, and under keys of their own what goes beside it."""
    checked = dict(checked)
    beside: dict[str, Any] = {
        key: checked.pop(key) for key in ("verdict", "warnings", "model_choice") if key in checked
    }
    base = len(estimate.model.base_names)
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "method": f"settled period, least squares on Fourier lines, then maximum likelihood; "
        f"{estimate.model.friction} friction, {estimate.model.drive} drive",
        "config": shown_path,
        "joints": len(config.joints),
        "parameters": _entries(estimate, 0, base),
        "extra": _entries(estimate, base, len(estimate.names)),
        "covariance": {"names": list(estimate.names), "matrix": estimate.covariance.tolist()},
        "fit": {
            "residual_rms_ticks": estimate.residual_steps.tolist(),
            "quantisation_floor_ticks": round(QUANTISATION_FLOOR_TICKS, 4),
            "samples_per_period": period.position.shape[1],
            "periods": period.periods,
            "model": estimate.model.description,
            "outliers": estimate.outliers,
            "correlation_time": estimate.correlation_time,
        },
        "validation": checked,
        **beside,
        "timing": timing,
        "arm": _arm(config),
    }
    truth = true_parameters(config)
    if truth is not None:
        result["truth"] = truth
    return result


def _arm(config: Config) -> dict[str, Any]:
    return {
        "gravity": config.arm.gravity,
        "rest_pose": config.arm.rest_pose,
        "joints": [
            {
                "name": joint.name,
                "model": joint.model,
                "mode": joint.drive_mode.name.lower(),
                "torque_per_goal": joint.torque_per_goal,
                "torque_per_goal_std": joint.torque_per_goal_std,
                "goal_limit": joint.goal_limit,
                "position_limit": joint.position_limit,
                "velocity_limit": joint.velocity_limit,
            }
            for joint in config.joints
        ],
    }


def _entries(estimate: Estimate, start: int, end: int) -> dict[str, Any]:
    return {
        estimate.names[index]: {
            "value": float(estimate.value[index]),
            "std": float(estimate.std[index]),
            "unit": estimate.units[index],
        }
        for index in range(start, end)
    }
