"""Detection of values that no servo arm can have, usually due to a wrong unit in an imported recording."""

import math
from collections.abc import Sequence

import numpy as np

from hil.estimator.baselines.zero import half_turns
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.models.bounds import bound_sentence
from hil.estimator.models.terms import joint_of, kind_of, term_of
from hil.estimator.simulation.back_emf import limited

TORQUE = (2e-3, 60.0)  # N m: the largest torque of the smallest and of the largest servos (PH54: 45 N m continuous)
PENDULUM = (0.01, 3.0)  # m: length of a pendulum with the joint's inertia and gravity
LINK = (0.01, 2.0)  # m: length of link 1, which follows from coupling and gravity_2
SURE = 4.0  # standard errors
UNKNOWN = 0.5  # ratio of standard error to value
NEGLIGIBLE = 0.01  # fraction of a joint's largest torque; dry friction below this does not matter
SHOWN = 1e-3  # fraction of a joint's largest torque, or a ratio, below which a value counts as zero


def implausible(
    recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: float, origin: Sequence[float] = ()
) -> list[str]:
    """One sentence for each impossible value.

    gravity: gravity in the arm's plane [m/s^2]. origin: columns.zero [rad]; () if there are no columns.
    """
    late = limited(estimate.parameters)
    return [
        *_torques(recordings),
        *_pendulum(estimate, gravity),
        *_link(estimate, gravity),
        *_weight(estimate, gravity, origin),
        *([bound_sentence(late)] if late else []),
    ]


def undetermined(recordings: Sequence[Recording], estimate: ShootingEstimate) -> list[str]:
    """One sentence naming the terms that are undetermined: their standard errors are as large as their values.

    If a joint has no dry friction, terms that only describe its shape do not matter.
    """
    smooth = _without_dry_friction(recordings, estimate)
    found = [
        f"{name} ({value:.3g} +- {std:.2g})" if std < math.inf else f"{name} (not at all)"
        for name, value, std in zip(estimate.names, estimate.value, estimate.std, strict=True)
        if term_of(name).standstill
        and joint_of(name) not in smooth
        and not (std < UNKNOWN * abs(value))
        and abs(value) > SHOWN
    ]
    if not found:
        return []
    return [
        f"Not determined by this motion: {', '.join(found)}. They describe friction near standstill only in "
        "combination with the other parameters; do not use them alone."
    ]


def _without_dry_friction(recordings: Sequence[Recording], estimate: ShootingEstimate) -> set[int]:
    """Joints, from 1, whose dry friction is known to be zero."""
    value, std = estimate.parameters, dict(zip(estimate.names, estimate.std.tolist(), strict=True))
    found = set()
    for joint in range(1, recordings[0].joints + 1):
        most = max(float(np.abs(each.torque[joint - 1]).max()) for each in recordings)
        name = f"coulomb_{joint}"
        rise = 1.0 + value.get(f"stribeck_rise_{joint}", 0.0)
        is_smooth = f"presliding_stiffness_{joint}" not in value
        if is_smooth and rise * abs(value[name]) + SURE * std[name] < NEGLIGIBLE * most:
            found.add(joint)
    return found


def _torques(recordings: Sequence[Recording]) -> list[str]:
    found = []
    for joint in range(recordings[0].joints):
        most = max(float(np.abs(each.torque[joint]).max()) for each in recordings)
        if most > TORQUE[1]:
            found.append(
                f"The torque of joint {joint + 1} reaches {most:.3g} N m, which few servos can deliver: check its unit."
            )
        elif 0.0 < most < TORQUE[0]:
            found.append(f"The torque of joint {joint + 1} never exceeds {most:.2g} N m: check its unit.")
    return found


def _pendulum(estimate: ShootingEstimate, gravity: float) -> list[str]:
    """Check inertia * gravity / weight, which is a length whatever the unit of torque; a wrong unit of time or angle
    makes it implausible.
    """
    if gravity <= 0.0:
        return []
    value, names = estimate.parameters, list(estimate.names)
    weight, inertia = value["gravity_1"], value["inertia_1"]
    if abs(weight) < SURE * float(estimate.std[names.index("gravity_1")]) or not weight:
        return []
    length = inertia * gravity / abs(weight)
    if PENDULUM[0] < length < PENDULUM[1]:
        return []
    return [
        f"The inertia and weight of joint 1 are those of a pendulum {length:.2g} m long: check the units of time and "
        "angle, and arm.gravity."
    ]


def _link(estimate: ShootingEstimate, gravity: float) -> list[str]:
    """Check coupling * gravity / gravity_2, which is the length of link 1 whatever the unit of torque."""
    value, names = estimate.parameters, list(estimate.names)
    if gravity <= 0.0 or "coupling" not in value:
        return []
    std = {name: float(estimate.std[names.index(name)]) for name in ("coupling", "gravity_2")}
    if not value["coupling"] > SURE * std["coupling"]:
        return []
    if abs(value["gravity_2"]) < SURE * std["gravity_2"]:
        least = value["coupling"] * gravity / LINK[1]
        if least < abs(value["gravity_2"]) + SURE * std["gravity_2"]:
            return []
        return [
            f"gravity_2 is {value['gravity_2']:.2g} +- {std['gravity_2']:.2g} N m, but coupling implies at least "
            f"{least:.2g} N m: the torque column does not include gravity. If the drive itself compensates for "
            "gravity, add that torque to the column. If the arm moves in a horizontal plane, set arm.gravity = 0."
        ]
    length = abs(value["coupling"] * gravity / value["gravity_2"])
    if LINK[0] < length < LINK[1]:
        return []
    return [
        f"According to coupling and gravity_2, link 1 would be {length:.2g} m long: check the units of time and angle, "
        "and arm.gravity."
    ]


def _weight(estimate: ShootingEstimate, gravity: float, origin: Sequence[float]) -> list[str]:
    """Check the signs of the gravity torques. origin: see `implausible`."""
    weights = {
        name: (value, SURE * std)
        for name, value, std in zip(estimate.names, estimate.value.tolist(), estimate.std.tolist(), strict=True)
        if kind_of(name) == "gravity" and gravity > 0.0
    }
    negative = [f"{name} is negative, {value:.3g} N m" for name, (value, least) in weights.items() if value < -least]
    if not negative:
        return []
    remedy = _right_zero(estimate, [value if abs(value) > least else 0.0 for value, least in weights.values()], origin)
    return [f"{'; '.join(negative)}: the zero of an angle is wrong (columns.zero), or a sign is reversed.{remedy}"]


def _right_zero(estimate: ShootingEstimate, weights: Sequence[float], origin: Sequence[float]) -> str:
    """State the zeros with which the gravity torques are positive; "" if there are no columns.

    weights: gravity torques [N m], 0 if not known.
    """
    half = half_turns(np.array(weights), 0.0)
    if len(origin) != len(weights) or half is None:
        return ""
    found = estimate.zeros.mean(axis=0) if estimate.zeros.size else np.zeros(len(weights))
    turned = (np.array(origin) + found + half + math.pi) % (2.0 * math.pi) - math.pi
    listed = ", ".join(f"{each:.4f}" for each in turned.tolist())
    return f" If the signs are right, set zero = [{listed}] in [columns]."
