"""Masses, centres of mass and inertias from base parameters and other known quantities of the arm.

Torque and position determine six combinations of ten quantities (for one joint, two combinations of four). Each known
length, mass or rotor inertia reduces the unknowns by one. A quantity without a component in the null space of the
equations is determined; the other quantities form inseparable groups.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.errors import ModelError
from hil.estimator.models.terms import RIGID_BODY

QUANTITY_UNITS = {"length": "m", "mass": "kg", "centre": "m", "link_inertia": "kg m^2", "armature": "kg m^2"}
QUANTITIES = {
    1: ("mass_1", "centre_1", "link_inertia_1", "armature_1"),
    2: (
        *("length_1", "mass_1", "centre_1", "link_inertia_1", "armature_1"),
        *("mass_elbow", "mass_2", "centre_2", "link_inertia_2", "armature_2"),
    ),
}
"""Names of the physical quantities, by number of joints.

Link i has a mass, a centre of mass (distance from joint i) and an inertia about the centre of mass; length_1 is the
distance from joint 1 to joint 2; mass_elbow is the second servo's mass; armature_i is rotor inertia times gear ratio
squared.
"""
OPEN = 1e-6  # a quantity with a larger component in the null space is not determined
SINGULAR = 1e-9
CONTRADICTION = 5.0  # standard errors


@dataclass(frozen=True)
class Known:
    """A quantity measured with a ruler or scales, or taken from a data sheet."""

    value: float
    std: float = 0.0
    """Standard error; 0 means exact."""


@dataclass(frozen=True)
class Quantities:
    """Physical quantities determined by base parameters and known quantities together."""

    value: dict[str, float]
    """Determined quantities by name [SI], including the known ones."""
    std: dict[str, float]
    """Standard errors of `value` by name [SI]."""
    groups: tuple[tuple[str, ...], ...]
    """Groups of quantities that cannot be separated; at least one more quantity in each group must be known."""
    doubts: tuple[str, ...]
    """Warnings about known quantities that contradict the data, and about physically impossible quantities."""


def base_of(quantities: Mapping[str, float], gravity: float, joints: int) -> Array:
    """Return the rigid-body base parameters [SI] of these quantities, in the order of `terms.RIGID_BODY`.

    gravity: acceleration of gravity [m/s^2]. See the table at the top of docs/model.md.
    """
    q = quantities
    inertia = q["link_inertia_1"] + q["mass_1"] * q["centre_1"] ** 2 + q["armature_1"]
    moment = q["mass_1"] * q["centre_1"]
    if joints == 1:
        return np.array([inertia, moment * gravity])
    beyond = q["mass_2"] + q["mass_elbow"]
    moment_2 = q["mass_2"] * q["centre_2"]
    return np.array(
        [
            inertia + beyond * q["length_1"] ** 2,
            q["length_1"] * moment_2,
            q["link_inertia_2"] + q["mass_2"] * q["centre_2"] ** 2,
            q["armature_2"],
            (moment + beyond * q["length_1"]) * gravity,
            moment_2 * gravity,
        ]
    )


def physical_quantities(
    base: Mapping[str, float], covariance: Array, known: Mapping[str, Known], gravity: float, joints: int
) -> Quantities:
    """Return masses, centres of mass and inertias with standard errors, and groups that cannot be separated.

    Args:
        base: rigid-body base parameters by name [SI].
        covariance: their covariance in the order of `terms.RIGID_BODY[joints]`.
        known: known quantities by name.
        gravity: acceleration of gravity [m/s^2].
        joints: number of joints.

    Raises:
        ModelError: for a known quantity that this arm does not have, or whose value or std is impossible.
    """
    _check(known, joints)
    names = RIGID_BODY[joints]
    goal = np.array([base[name] for name in names])
    if gravity == 0.0:
        rows = np.array([not name.startswith("gravity") for name in names])
    else:
        rows = np.ones(len(names), dtype=np.bool_)
    unknown = [name for name in QUANTITIES[joints] if name not in known or known[name].std > 0.0]
    exact = {name: item.value for name, item in known.items() if item.std == 0.0}
    measured = {name: item for name, item in known.items() if item.std > 0.0}
    floor = np.diag(1e-18 + 1e-14 * goal[rows] ** 2)
    whiten = linalg.inv(linalg.cholesky(covariance[np.ix_(rows, rows)] + floor))

    def misfit(x: Array, whitened: bool) -> Array:
        given = exact | dict(zip(unknown, x.tolist(), strict=True))
        off = (base_of(given, gravity, joints) - goal)[rows]
        priors = [
            (given[name] - item.value) / (item.std if whitened else abs(item.value)) for name, item in measured.items()
        ]
        scale = np.maximum(np.abs(goal[rows]), 1e-12)
        return np.concatenate((whiten @ off if whitened else off / scale, priors))

    start = np.array([_guess(name, base, known, gravity) for name in unknown])
    unit = np.maximum(np.abs(start), 1e-9)
    rough = linalg.least_squares(misfit, start, x_scale=unit, args=(False,), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fine = linalg.least_squares(misfit, rough.x, x_scale=unit, args=(True,), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    size = np.maximum(np.abs(fine.x), 1e-3 * unit)
    null = _null_space(_slope(lambda x: misfit(x, False), fine.x, size))
    spread = _spread(_slope(lambda x: misfit(x, True), fine.x, size)) * size
    fixed = np.abs(null).max(axis=1, initial=0.0) < OPEN
    value = exact | {name: float(fine.x[i]) for i, name in enumerate(unknown) if fixed[i]}
    std = dict.fromkeys(exact, 0.0) | {name: float(spread[i]) for i, name in enumerate(unknown) if fixed[i]}
    doubts = _doubts(value, std, known, float(np.sqrt(2.0 * fine.cost)))
    order = [name for name in QUANTITIES[joints] if name in value]
    groups = _groups([name for i, name in enumerate(unknown) if not fixed[i]], null[~fixed])
    return Quantities({n: value[n] for n in order}, {n: std[n] for n in order}, groups, doubts)


def _check(known: Mapping[str, Known], joints: int) -> None:
    for name, item in known.items():
        if name not in QUANTITIES[joints]:
            raise ModelError(f"known.{name}: an arm of {joints} joints has only {', '.join(QUANTITIES[joints])}")
        positive = name.startswith(("length", "mass_1", "mass_2"))
        if not np.isfinite(item.value) or item.std < 0.0 or (positive and item.value <= 0.0):
            raise ModelError(
                f"known.{name} = {item.value:g}, std {item.std:g}: lengths and masses must be positive, "
                "and std must not be negative"
            )


def _guess(name: str, base: Mapping[str, float], known: Mapping[str, Known], gravity: float) -> float:
    """Return an initial guess of the right magnitude; the determined quantities do not depend on it."""
    if name in known:
        return known[name].value
    length = 0.2
    if gravity > 0.0 and base.get("gravity_2"):
        length = abs(base.get("coupling", 0.0)) * gravity / abs(base["gravity_2"]) or length
    if "length_1" in known:
        length = known["length_1"].value
    inertia = max(abs(base["inertia_1"]), 1e-9)
    mass = inertia / length**2
    guesses = {"length": length, "mass": 0.3 * mass, "centre": 0.5 * length, "link_inertia": 0.1 * inertia}
    kind = name.rsplit("_", 1)[0]
    return abs(base.get(name, 0.0)) or 0.1 * inertia if kind == "armature" else guesses[kind]


def _slope(function: object, x: Array, size: Array) -> Array:
    """Return the derivatives of `function` with respect to x / size, by central differences."""
    assert callable(function)
    columns = []
    for i in range(x.size):
        step = np.zeros_like(x)
        step[i] = 1e-5 * size[i]
        columns.append((function(x + step) - function(x - step)) / 2e-5)
    return np.stack(columns, axis=1)


def _null_space(slope: Array) -> Array:
    """Return a basis of the null space of `slope` (unknowns, directions)."""
    _, size, Vt = linalg.svd(slope)
    rank = int(np.sum(size > SINGULAR * size[0]))
    null: Array = Vt[rank:].T
    return null


def _spread(slope: Array) -> Array:
    norm = np.maximum(np.linalg.norm(slope, axis=0), 1e-300)
    _, size, Vt = linalg.svd(slope / norm, full_matrices=False)
    seen = size > SINGULAR * size[0]
    std: Array = np.sqrt(np.sum((Vt[seen].T / size[seen]) ** 2, axis=1)) / norm
    return std


def _groups(names: list[str], null: Array) -> tuple[tuple[str, ...], ...]:
    """Return groups of names that are linked, directly or indirectly, by directions of the null space."""
    tied = np.abs(null @ null.T) > OPEN
    groups: list[tuple[str, ...]] = []
    left = set(range(len(names)))
    while left:
        group = {min(left)}
        while True:
            more = {j for i in group for j in left if tied[i, j]} | group
            if more == group:
                break
            group = more
        groups.append(tuple(names[i] for i in sorted(group)))
        left -= group
    return tuple(groups)


def _doubts(
    value: Mapping[str, float], std: Mapping[str, float], known: Mapping[str, Known], misfit: float
) -> tuple[str, ...]:
    doubts = [
        f"{name} is estimated as {number:.4g}, {abs(number) / max(std[name], 1e-300):.1f} standard errors below "
        "zero: a known quantity or a torque constant is wrong"
        for name, number in value.items()
        if number < 0.0 and not name.startswith("centre") and -number > 2.0 * std[name]
    ]
    if misfit > CONTRADICTION:
        doubts.append(
            f"the known quantities ({', '.join(known)}) and the data contradict each other by {misfit:.0f} standard "
            "errors: measure them again, or specify a std for each"
        )
    return tuple(doubts)
