"""Model terms that a robot description cannot represent; they are reported in the terminal and in the file."""

import numpy as np

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.estimator.chain.model.late_torque import MEANINGS as LATE
from hil.estimator.chain.model.tilt import MEANINGS
from hil.estimator.models.terms import kind_of, term_of

LEVEL = 1e-6
"""The base counts as upright if, in its frame, the horizontal part of gravity is at most this fraction of the whole."""

_SAID_ELSEWHERE = ("inertia", "coupling", "gravity", "viscous", "coulomb", "torque_scale")
"""Terms that need no sentence, because every robot description has them or because `torque_constants` reports them."""


def left_out(model: ArmModel, carried: tuple[str, ...] = ()) -> list[str]:
    """One sentence per model parameter that the format cannot represent. carried: terms that it does represent."""
    elsewhere = (*_SAID_ELSEWHERE, *carried)
    return [_sentence(name, value) for name, value in model.values.items() if kind_of(name) not in elsewhere]


def chain_left_out(model: ChainArmModel, carried: tuple[str, ...] = ()) -> list[str]:
    """One sentence per parameter of a spatial arm that the format cannot represent.

    The links in the file represent all base parameters. carried: other terms that the format can represent.
    """
    elsewhere = {*_SAID_ELSEWHERE, *carried}
    names = [name for name in model.values if name not in model.groups and kind_of(name) not in elsewhere]
    return [_sentence(name, model.values[name]) for name in names]


def base_orientation(model: ChainArmModel) -> list[str]:
    """A note if the arm's base is not upright: gravity then does not act along the base's -z axis."""
    gravity = model.base_gravity
    if np.hypot(*gravity[:2]) <= LEVEL * np.linalg.norm(gravity) and gravity[2] <= 0.0:
        return []
    x, y, z = (0.0 + np.round(gravity, 3)).tolist()
    return [
        f"the orientation of the base: in its frame, gravity is ({x:g}, {y:g}, {z:g}) m/s^2. Mount the arm accordingly "
        "in the simulator, or set the simulator's gravity to this"
    ]


def _sentence(name: str, value: float) -> str:
    if name in MEANINGS:
        unit, meaning = "rad", MEANINGS[name]
    elif kind_of(name) in LATE:
        unit, meaning = "1", LATE[kind_of(name)]
    else:
        unit, meaning = term_of(name).unit, term_of(name).meaning
    return f"{name} = {value:.6g}{'' if unit == '1' else f' {unit}'} ({meaning})"


def torque_constants(model: ArmModel) -> list[str]:
    """One sentence per joint about its torque constant."""
    return [
        f"torque per goal of {joint.name} = {model.torque_per_goal(number):.6g} N m/{joint.goal_unit}"
        for number, joint in enumerate(model.joints, start=1)
        if joint.goal_unit != "N m"
    ]
