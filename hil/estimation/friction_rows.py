"""Friction at low, middle and high speed with its standard error: what the parameters of its rise say together.

How high friction rises and how fast it falls are known together far better than each alone, so that a change which no
single parameter shows is plain in the curve.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.arm_model import ArmModel
from hil.results.parts import Covariance

SHARES = (0.15, 0.5, 1.0)
"""Speeds, of the speed at which the rise has fallen to 1/e."""
DIFFERENCE = 1e-4
"""Of a parameter or its standard error, for derivatives."""


@dataclass(frozen=True)
class FrictionRow:
    """Friction of a joint at one speed, of two models [N m]. std: its standard error in each."""

    name: str
    value: tuple[float, float]
    std: tuple[float, float]


def friction_rows(
    models: tuple[ArmModel, ArmModel], covariances: tuple[Covariance | None, Covariance | None]
) -> list[FrictionRow]:
    """Rows of every joint whose friction rises at low speed in both models; none without both covariances."""
    first, second = covariances
    if first is None or second is None:
        return []
    rows = []
    for joint in range(1, len(models[0].joints) + 1):
        name = f"stribeck_velocity_{joint}"
        if not all(name in model.values for model in models):
            continue
        typical = math.sqrt(models[0].values[name] * models[1].values[name])
        for share in SHARES:
            speed = share * typical
            found = [_at(model, kept, joint, speed) for model, kept in zip(models, (first, second), strict=True)]
            values, stds = (found[0][0], found[1][0]), (found[0][1], found[1][1])
            rows.append(FrictionRow(f"friction_{joint} at {speed:.2g} rad/s", values, stds))
    return rows


def _at(model: ArmModel, kept: Covariance, joint: int, speed: float) -> tuple[float, float]:
    """Friction at `speed` [rad/s] and its standard error [N m]."""
    names = [name for name in kept.names if name.endswith(f"_{joint}") and name in model.values]
    index = [kept.names.index(name) for name in names]
    covariance = kept.array()[np.ix_(index, index)]
    value = _friction(model, model.values, joint, speed)
    slopes = []
    for name in names:
        step = DIFFERENCE * (abs(model.values[name]) or 1.0)
        moved = {**model.values, name: model.values[name] + step}
        slopes.append((_friction(model, moved, joint, speed) - value) / step)
    slope = np.array(slopes)
    used = slope != 0.0
    if not np.all(np.isfinite(covariance[np.ix_(used, used)])):
        return value, math.inf
    return value, math.sqrt(max(0.0, float(slope[used] @ covariance[np.ix_(used, used)] @ slope[used])))


def _friction(model: ArmModel, values: Mapping[str, float], joint: int, speed: float) -> float:
    changed = ArmModel(values, model.stds, model.gravity, model.rest_pose, model.joints)
    return float(changed.friction_torque(np.full(len(model.joints), speed))[joint - 1])
