"""Detection of angles with a wrong scale: an encoder resolution, belt ratio or gear ratio other than the stated one.

A joint's equation is linear in its angle except for gravity, so only gravity reveals the scale. Near the angle at which
the joint hangs, g sin(x / s) is almost g / s^3 sin x + (g / s - g / s^3) x, i.e. weaker gravity plus a spring. A model
with a spring, an offset and an encoder zero therefore fits angles with a wrong scale s down to the noise, but its
values are wrong. So if a fit finds a spring, the motion is fitted again without the spring but with the scale that
would have the same effect.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting

SPRING = "cable_stiffness_1"
CERTAIN = 4.0  # number of standard errors by which a spring must differ from 0 to be examined
LEAST = 0.01  # smallest deviation of a scale from 1 that is reported
FARTHEST = 0.5, 2.0
AS_WELL = 1.02  # largest ratio of the residuals at which the scale counts as explaining the motion equally well
HANGS_AT = 0.3  # rad; the zero reveals the scale only if the joint hangs at least this far from the columns' origin
CONSISTENT = 0.4  # largest difference between scales inferred from zero and spring, relative to their deviation from 1
RESTS = 0.2  # largest spring torque where the joint would hang, relative to the spring torque's range


@dataclass(frozen=True)
class _Scale:
    """Angles of joint 1 that seem to be `factor` times the true ones.

    by_zero: whether this factor was inferred from the encoder zero.
    """

    factor: float
    by_zero: bool


def angle_scale(
    recordings: Sequence[Recording], estimate: ShootingEstimate, origin: Sequence[float] = ()
) -> tuple[str, ...]:
    """A sentence if the spring and the encoder zero of joint 1 may be due to a wrong scale of its angle.

    origin: the angles at which the recordings' position columns are 0 [rad]; by default, 0.
    """
    about = np.array(origin) if len(origin) else np.zeros(estimate.model.joints)
    scale = _candidate(recordings, estimate, about)
    fitted = None if scale is None else _without_spring(recordings, estimate, scale, about)
    return () if fitted is None else (_said(*fitted, estimate),)


def _candidate(recordings: Sequence[Recording], estimate: ShootingEstimate, about: Array) -> _Scale | None:
    """The angle scale of the first joint that would have the same effect as the spring in the estimate.

    A wrong scale of another joint also changes that joint's effect on the first one, which no spring can imitate.
    """
    value, names = estimate.parameters, list(estimate.names)
    if SPRING not in names or not value["gravity_1"] > 0.0:
        return None
    ratio = value[SPRING] / value["gravity_1"]
    if abs(value[SPRING]) < CERTAIN * float(estimate.std[names.index(SPRING)]) or ratio <= -1.0:
        return None
    by_spring, hangs = math.sqrt(1.0 + ratio), -0.5 * math.pi - float(about[0])
    if estimate.zeros.size and abs(hangs) > HANGS_AT:
        found = _Scale(1.0 - float(np.mean(estimate.zeros[:, 0])) / hangs, True)
        if abs(found.factor - by_spring) > CONSISTENT * abs(by_spring - 1.0):
            return None
    elif abs(hangs) <= HANGS_AT and _rests_hanging(recordings, estimate):
        found = _Scale(by_spring, False)
    else:
        return None
    return found if abs(found.factor - 1.0) >= LEAST and FARTHEST[0] <= found.factor <= FARTHEST[1] else None


def _rests_hanging(recordings: Sequence[Recording], estimate: ShootingEstimate) -> bool:
    """Whether the spring is slack where the joint hangs, judging by the offset."""
    value = estimate.parameters
    stiffness, offset = value[SPRING], value["offset_1"]
    moved = max(float(np.ptp(each.filled()[0])) for each in recordings)
    return abs(offset - 0.5 * math.pi * stiffness) < RESTS * abs(stiffness) * moved


def _without_spring(
    recordings: Sequence[Recording], estimate: ShootingEstimate, scale: _Scale, about: Array
) -> tuple[_Scale, ShootingEstimate] | None:
    """The fit with this scale, without springs and with the zeros as given, if it explains the motion equally well."""
    limit = AS_WELL * estimate.residual_over_noise
    if not scale.by_zero:  # a spring only approximates a scale: the remaining spring corrects the factor
        refined = _fitted(recordings, estimate, scale, about, spring=True)
        if refined is None:
            return None
        left = refined.parameters[SPRING] / refined.parameters["gravity_1"]
        scale = replace(scale, factor=scale.factor * math.sqrt(max(1.0 + left, FARTHEST[0] ** 2)))
    found = _fitted(recordings, estimate, scale, about, spring=False)
    if found is None or np.any(found.residual_over_noise > limit):
        return None
    return scale, found


def _fitted(
    recordings: Sequence[Recording], estimate: ShootingEstimate, scale: _Scale, about: Array, *, spring: bool
) -> ShootingEstimate | None:
    factor = np.where(np.arange(estimate.model.joints) == 0, scale.factor, 1.0)
    model = estimate.model if spring else estimate.model.without("cable")
    start = estimate.value[: len(model.base_names)]
    try:
        return estimate_by_shooting(_scaled(recordings, factor, about), model, start, length=estimate.segment_length)
    except EstimationError:
        return None


def _scaled(recordings: Sequence[Recording], factor: Array, about: Array) -> list[Recording]:
    """The recordings, with each angle's distance from `about` (joints,) [rad] divided by `factor` (joints,)."""
    centre = about[:, None]
    return [
        replace(
            each,
            position=centre + (each.position - centre) / factor[:, None],
            position_step=each.position_step / factor,
        )
        for each in recordings
    ]


def _said(scale: _Scale, found: ShootingEstimate, estimate: ShootingEstimate) -> str:
    instead = "the fitted spring and encoder zero" if scale.by_zero else "the fitted spring"
    cause = (
        ""
        if scale.by_zero
        else " Only a spring that is slack where joint 1 hangs would have the same effect: if the arm has such a "
        "spring, this model is right."
    )
    given, other = estimate.parameters["gravity_1"], found.parameters["gravity_1"]
    return (
        f"The angle of joint 1 seems to be {scale.factor:.4g} times the true one: with the angle divided by this "
        f"factor, the motion is explained equally well without {instead}, and gravity_1 is {other:.4g} instead of "
        f"{given:.4g} N m. Check the unit, the ticks per turn and the belt or gear ratio between encoder and joint "
        f"1.{cause}"
    )
