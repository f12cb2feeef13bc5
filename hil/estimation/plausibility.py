"""Plausibility checks: identified values that are impossible or contradict the configuration."""

from collections.abc import Sequence

import numpy as np

from hil.config.known_quantities import KnownConfig
from hil.config.recording import ArmFacts
from hil.config.schema import ArmConfig, Config
from hil.estimation.torque_constants import contradictions, ratios_of
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.identify import Estimate
from hil.estimator.models.conflicts import Conflict, conflicts
from hil.estimator.models.model import LEVER_STD
from hil.plan.chain_model import torque_constant_stds

DEVIATIONS = 4.0  # standard errors
LENGTH_TOLERANCE = 0.05  # relative; link lengths are measured with a ruler
_UPRIGHT = 0.5  # sine of a link's angle above the horizontal
FLAT = 0.02  # fraction of the largest commanded torque, below which gravity counts as absent

MOSTLY_BORROWED, CLEARLY_WIDER = 0.85, 2.0
"""Limits on the standard error of the length of link 1 that follows from the parameters, relative to the standard error
of the prior. Above the first, the length comes mainly from the prior; above the second, the prior must have been
widened (`LEVER_DOUBTED`).
"""


def doubts(
    config: Config, estimate: Estimate, largest_torque: float, known: Sequence[Conflict] = ()
) -> tuple[str, ...]:
    """One sentence per contradiction, except for those in `known`, which are reported separately.

    largest_torque: largest commanded torque [N m].
    """
    ratios = ratios_of(estimate.names, estimate.value, estimate.std)
    joints = [joint.name for joint in config.joints]
    return (
        *wrong_length(link_length(config.known, config.arm), config.arm.gravity, estimate),
        *_weight(config, estimate, largest_torque),
        *contradictions(joints, ratios, torque_scale_std(config), "constant", known),
    )


def wrong_length(length: float | None, gravity: float, estimate: Estimate | ShootingEstimate) -> list[str]:
    """If the `length` of link 1 [m] is known, check that coupling * gravity / gravity_2 equals it.

    gravity: gravity in the arm's plane [m/s^2].
    """
    seen = _seen_length(gravity, estimate)
    if length is None or seen is None:
        return []
    found, std = seen
    if not abs(found - length) > max(DEVIATIONS * std, LENGTH_TOLERANCE * length):
        return []
    return [
        f"coupling * gravity / gravity_2 = {found:.3g} +- {std:.1g} m should equal the length of link 1, {length:.3g} "
        "m: arm.gravity, the plane's tilt or that length is wrong, or the model is incomplete."
    ]


def _seen_length(gravity: float, estimate: Estimate | ShootingEstimate) -> tuple[float, float] | None:
    """Length of link 1 that follows from the parameters, with its standard error [m]; None if they do not determine it.

    gravity: gravity in the arm's plane [m/s^2].
    """
    if estimate.model.joints != 2 or not gravity:
        return None
    value = estimate.parameters
    coupling, weight = value["coupling"], value["gravity_2"]
    if not coupling or not weight:
        return None
    found = coupling * gravity / weight
    at = [estimate.names.index(name) for name in ("coupling", "gravity_2")]
    covariance = estimate.covariance[np.ix_(at, at)]
    if not np.isfinite(covariance).all():
        return None
    slope = np.array([found / coupling, -found / weight])
    return found, float(np.sqrt(max(0.0, slope @ covariance @ slope)))


def borrowed_length(config: Config, estimate: Estimate) -> tuple[str, ...]:
    """Return a sentence if the coupling is known mainly from `arm.link_lengths`, or if the motion contradicts that
    length but hardly determines it.
    """
    seen = _seen_length(config.arm.gravity, estimate)
    if estimate.model.lever is None or config.arm.link_lengths is None or seen is None:
        return ()
    length, (found, std) = config.arm.link_lengths[0], seen
    share = std / abs(found) / LEVER_STD
    if share < MOSTLY_BORROWED:
        return ()
    if share > CLEARLY_WIDER:
        return (
            f"The motion hardly determines the length of link 1 ({found:.2g} +- {std:.1g} m) and may contradict "
            f"arm.link_lengths[0] = {length:g} m: measure it again.",
        )
    return (
        f"The motion hardly determines the coupling, which therefore rests on arm.link_lengths[0] = {length:g} m, "
        f"assumed to be right to within {100 * LEVER_STD:g} %. If that length is wrong, coupling, inertia_2 and "
        "armature_2 are wrong, too: measure it again.",
    )


def _weight(config: Config, estimate: Estimate, largest_torque: float) -> list[str]:
    """Check the sign of gravity and whether gravity acts at all."""
    said = []
    for joint in range(1, estimate.model.joints + 1):
        value = estimate.parameters[f"gravity_{joint}"]
        std = float(estimate.std[estimate.names.index(f"gravity_{joint}")])
        sure = abs(value) > DEVIATIONS * std and abs(value) > FLAT * largest_torque
        if not config.arm.gravity:
            if sure:
                said.append(
                    f"arm.gravity = 0, but gravity_{joint} is {value:.3g} +- {std:.1g} N m: the arm is not horizontal."
                )
        elif sure and value < 0.0 and not _hangs_upwards(config, joint - 1):
            said.append(
                f"gravity_{joint} is negative, {value:.3g} N m: zero_ticks is half a turn off, direction is wrong, or "
                "a counterweight outweighs the link."
            )
    return said


def _hangs_upwards(config: Config, joint: int) -> bool:
    """Whether a link rests pointing up without support, which implies that its centre of mass lies below its joint."""
    angle = float(np.sum(config.arm.rest_pose[: joint + 1]))
    return config.stabiliser is None and np.sin(angle) > _UPRIGHT


def conflicts_of(config: Config, estimate: Estimate) -> tuple[Conflict, ...]:
    """Values of `estimate` that are far from what the configuration and typical servos imply."""
    return conflicts(estimate.names, estimate.value, estimate.std, torque_scale_std(config))


def torque_scale_std(config: Config) -> dict[str, float]:
    """Relative standard deviation of the ratio of the torque constants, by parameter; empty if the file gives none."""
    unsure = torque_constant_stds(config)
    return {"torque_scale_2": float(np.linalg.norm(unsure))} if unsure.size == 2 and unsure.any() else {}


def link_length(known: KnownConfig | None, arm: ArmConfig | ArmFacts) -> float | None:
    """Length of link 1 [m] from [known] or link_lengths; None if neither is given."""
    if known is not None and known.length_1 is not None:
        return known.quantities()["length_1"].value
    return None if arm.link_lengths is None else arm.link_lengths[0]
