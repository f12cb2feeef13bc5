"""Detection of unit mistakes, such as degrees for radians, mm for m, or mA for A: such a file is valid but dangerous.

Every physical quantity is compared, with a wide margin, with what a servo of that model could move: external gears,
light plastic links and heavy test rigs pass; a factor due to a wrong unit does not.
"""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hil.drivers.servo_model import Mode, servo_model

if TYPE_CHECKING:
    from hil.config.joint import JointConfig
    from hil.config.schema import Config

_MOST_TURN_RAD = 4 * math.pi
_LONGEST_M = 3.0
_SHORTEST_M = 2e-3
_MOST_INERTIA = 100.0  # kg m^2
_GEAR = 8.0
"""Largest ratio of a torque constant to the published one: an external gear, or a very bad guess."""

_SPEED = 4.0
"""Largest ratio of the velocity limit to the no-load speed, at which the back-EMF equals the supply voltage."""

_CURRENT = 2.0
"""Largest ratio of the current limit to the model's stall current."""

_LEVER_M = 0.05
"""A link mass is implausible if the servo's stall torque could not hold it at this lever arm [m]."""


def implausible(config: "Config") -> Iterator[str]:
    """Yield one sentence for each quantity that looks like a unit mistake."""
    for joint in config.joints:
        yield from _joint(joint)
    yield from _angles("arm.rest_pose", config.arm.rest_pose)
    yield from _angles("arm.rest_tolerance", [config.arm.rest_tolerance], most=math.pi)
    if config.arm.link_lengths is not None:
        for joint, length in zip(config.joints, config.arm.link_lengths, strict=True):
            yield from _length(f"arm.link_lengths of joint {joint.name!r}", length)
    yield from _prior(config)
    yield from _stabiliser(config)
    yield from _known(config)


def _joint(joint: "JointConfig") -> Iterator[str]:
    where, model = f"joint {joint.name!r}", servo_model(joint.model)
    yield from _angles(f"position_limit of {where}", joint.position_limit)
    pwm = joint.drive_mode is Mode.PWM
    name, unit = ("torque_per_volt", "N m/V") if pwm else ("torque_constant", "N m/A")
    published = (model.torque_per_volt if pwm else model.torque_per_ampere).value
    ratio = joint.torque_per_goal / published
    if not 1 / _GEAR < ratio < _GEAR:
        yield (
            f"{name} of {where} = {joint.torque_per_goal:g} {unit} is {ratio:.3g} times the published {published:.3g} "
            f"{unit} of a {joint.model}. Use N m at the output shaft, not mN m, kgf cm or the torque of the bare motor"
        )
    fastest = max(stall.voltage for stall in model.stalls) / model.torque_per_ampere.low
    if joint.velocity_limit > _SPEED * fastest:
        yield (
            f"velocity_limit of {where} = {joint.velocity_limit:g} rad/s: a {joint.model} cannot exceed {fastest:.2g} "
            f"rad/s. If it is in degrees/s, write {math.radians(joint.velocity_limit):.3g}; if in rpm, "
            f"{joint.velocity_limit * math.pi / 30:.3g}"
        )
    stall = max(stall.voltage if pwm else stall.current for stall in model.stalls)
    if joint.goal_limit > _CURRENT * stall:
        name, unit, kind = ("voltage_limit", "V", "supply") if pwm else ("current_limit", "A", "stall current")
        yield (
            f"{name} of {where} = {joint.goal_limit:g} {unit}: the {kind} of a {joint.model} is {stall:g} {unit}. "
            f"If it is in m{unit}, write {joint.goal_limit / 1000:.3g}"
        )


def _angles(key: str, values: Sequence[float], most: float = _MOST_TURN_RAD) -> Iterator[str]:
    if max(abs(value) for value in values) > most:
        shown = ", ".join(f"{value:g}" for value in values)
        radians = ", ".join(f"{math.radians(value):.4g}" for value in values)
        turns = max(abs(value) for value in values) / (2 * math.pi)
        yield f"{key} = [{shown}] rad: that is up to {turns:.2g} turns. If it is in degrees, write [{radians}]"


def _length(key: str, length: float) -> Iterator[str]:
    if length > _LONGEST_M:
        yield f"{key} = {length:g} m is longer than any servo arm. If it is in mm, write {length / 1000:.4g}"
    elif length < _SHORTEST_M:
        yield f"{key} = {length:g} m is shorter than any servo. Give it in metres, from joint to joint"


def _prior(config: "Config") -> Iterator[str]:
    prior = config.arm.prior
    if prior is None:
        return
    for index, joint in enumerate(config.joints):
        stall = _stall_torque(joint)
        bounds = {
            "link_mass": (_heaviest(stall), "kg"),
            "servo_mass": (_heaviest(stall), "kg"),
            "link_centre": (_LONGEST_M, "m"),
            "link_inertia": (_MOST_INERTIA, "kg m^2"),
            "armature": (_MOST_INERTIA, "kg m^2"),
            "viscous": (5 * stall, "N m s/rad"),
            "coulomb": (stall, "N m"),
        }
        for key, (most, unit) in bounds.items():
            values = getattr(prior, key)
            if values is not None:
                yield from _too_much(f"arm.prior.{key} of joint {joint.name!r}", values[index], most, unit, joint)


def _stabiliser(config: "Config") -> Iterator[str]:
    if config.stabiliser is None:
        return
    for index, joint in enumerate(config.joints):
        stall = _stall_torque(joint)
        for key, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
            value = getattr(config.stabiliser, key)[index]
            yield from _too_much(f"stabiliser.{key} of joint {joint.name!r}", value, 50 * stall, unit, joint)


def _known(config: "Config") -> Iterator[str]:
    if config.known is None:
        return
    strongest = max(config.joints, key=_stall_torque)
    for name, known in config.known.quantities().items():
        key = f"known.{name}"
        if name.startswith(("length", "centre")):
            if abs(known.value) > _LONGEST_M:
                yield from _length(key, known.value)
        elif name.startswith("mass"):
            yield from _too_much(key, known.value, _heaviest(_stall_torque(strongest)), "kg", strongest)
        else:
            yield from _too_much(key, known.value, _MOST_INERTIA, "kg m^2", strongest)


def _stall_torque(joint: "JointConfig") -> float:
    """The highest published stall torque [N m], scaled up if the joint's torque constant indicates an external gear."""
    model = servo_model(joint.model)
    pwm = joint.drive_mode is Mode.PWM
    published = (model.torque_per_volt if pwm else model.torque_per_ampere).value
    return max(stall.torque for stall in model.stalls) * max(1.0, joint.torque_per_goal / published)


def _heaviest(stall_torque: float) -> float:
    """Mass [kg] that the servo can just hold at a very short lever arm."""
    return stall_torque / (9.81 * _LEVER_M)


def _too_much(key: str, value: float, most: float, unit: str, joint: "JointConfig") -> Iterator[str]:
    if value > most:
        yield (
            f"{key} = {value:g} {unit}: far more than a {joint.model} can move ({most:.3g} {unit}). Use SI units "
            "for all quantities: kg, m, N m, rad, s"
        )
