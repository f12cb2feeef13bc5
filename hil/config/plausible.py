"""Detection of unit errors (such as degrees for radians, mm for m, mA for A) that make a valid file dangerous.

Every physical quantity is compared with what a servo of that model could move. The margin is so wide that external
gears, light plastic links and heavy test rigs pass, but wrong units do not.
"""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hil.drivers.servo_model import Mode, servo_model, with_article
from hil.fakes.plants.arm import PI
from hil.unit_hints import in_other_units

if TYPE_CHECKING:
    from hil.config.joint import JointConfig
    from hil.config.schema import Config

_MOST_TURN_RAD = 4 * PI
_LONGEST_M = 3.0
_SHORTEST_M = 2e-3
_LEAST_TIME_SQUARED = 0.1  # s^2/rad
"""Largest plausible ratio of inertia to stall torque [s^2/rad]: such a joint accelerates at no more than 10 rad/s^2,
a tenth of the usual value.
"""

_MOST_ROTOR = 1e-4  # kg m^2, on the motor's side of the gears
_GEAR = 8.0
"""Largest plausible ratio of a torque constant to the published one, allowing for external gears and rough guesses."""

_SPEED = 4.0
"""Largest plausible ratio of the velocity limit to the no-load speed at the highest published supply voltage."""

_CURRENT = 2.0
"""Largest plausible ratio of the current limit to the model's stall current."""

_PERCENT = 100.0
_LEVER_M = 0.05
"""A link mass is implausible if the servo's stall torque could not hold it at this lever arm [m]."""


def implausible(config: "Config") -> Iterator[str]:
    """Yield one sentence for each quantity that looks like a unit error."""
    for joint in config.joints:
        yield from _joint(joint)
    yield from _angles("arm.rest_pose", config.arm.rest_pose)
    yield from _angles("arm.rest_tolerance", [config.arm.rest_tolerance], most=PI)
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
            f"{unit} of {with_article(joint.model)}. Use N m at the output shaft, not mN m, kgf cm or the torque of "
            "the bare motor" + _meant(joint.torque_per_goal, unit, _GEAR * published, published / _GEAR)
        )
    std = joint.torque_per_goal_std
    if std > joint.torque_per_goal:
        percent = f"; if it is in percent, write {std / 100 * joint.torque_per_goal:.3g}" if std < _PERCENT else ""
        yield (
            f"{name}_std of {where} = {std:g} {unit} is more than {name} itself"
            + (_meant(std, unit, joint.torque_per_goal) or f". It is a standard error in {unit}")
            + percent
        )
    volts = max(stall.voltage for stall in model.stalls)
    fastest = volts / model.back_emf
    # The stall figures imply a no-load speed up to twice as high; a limit derived from them is not a unit error.
    most = _SPEED * max(fastest, volts / model.torque_per_ampere.low)
    if joint.velocity_limit > most:
        yield (
            f"velocity_limit of {where} = {joint.velocity_limit:g} rad/s: the no-load speed of {joint.model} is "
            f"{fastest:.2g} rad/s at {volts:g} V{_meant(joint.velocity_limit, 'rad/s', most)}"
        )
    stall = max(stall.voltage if pwm else stall.current for stall in model.stalls)
    if joint.goal_limit > _CURRENT * stall:
        name, unit, kind = ("voltage_limit", "V", "supply") if pwm else ("current_limit", "A", "stall current")
        yield (
            f"{name} of {where} = {joint.goal_limit:g} {unit}: the {kind} of {with_article(joint.model)} is "
            f"{stall:g} {unit}" + _meant(joint.goal_limit, unit, _CURRENT * stall)
        )


def _angles(key: str, values: Sequence[float], most: float = _MOST_TURN_RAD) -> Iterator[str]:
    if max(abs(value) for value in values) > most:
        shown = ", ".join(f"{value:g}" for value in values)
        turns = max(abs(value) for value in values) / (2 * math.pi)
        hint = in_other_units(values, "rad", lambda value: abs(value) <= most)
        said = f"that is up to {turns:.2g} turns; at most {most:.4g} rad is allowed"
        yield f"{key} = [{shown}] rad: {said}" + (f". {hint}" if hint else "")


def _length(key: str, length: float) -> Iterator[str]:
    if length > _LONGEST_M:
        yield f"{key} = {length:g} m is longer than any servo arm{_meant(length, 'm', _LONGEST_M)}"
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
            "link_inertia": (_LEAST_TIME_SQUARED * stall, "kg m^2"),
            "armature": (_LEAST_TIME_SQUARED * stall, "kg m^2"),
            "viscous": (2 * stall, "N m s/rad"),
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
        for key, unit, times in (("stiffness", "N m/rad", 20.0), ("damping", "N m s/rad", 2.0)):
            value = getattr(config.stabiliser, key)[index]
            yield from _too_much(f"stabiliser.{key} of joint {joint.name!r}", value, times * stall, unit, joint)


def _known(config: "Config") -> Iterator[str]:
    if config.known is None:
        return
    strongest = max(config.joints, key=_stall_torque)
    for name in ("rotor_inertia_1", "rotor_inertia_2"):
        rotor = getattr(config.known, name)
        if rotor is not None:
            value = rotor if isinstance(rotor, float) else rotor.value
            yield from _too_much(f"known.{name}", value, _MOST_ROTOR, "kg m^2", strongest)
    for name, known in config.known.quantities().items():
        key = f"known.{name}"
        if name.startswith(("length", "centre")):
            if abs(known.value) > _LONGEST_M:
                yield from _length(key, known.value)
        elif name.startswith("mass"):
            yield from _too_much(key, known.value, _heaviest(_stall_torque(strongest)), "kg", strongest)
        else:
            most = _LEAST_TIME_SQUARED * _stall_torque(strongest)
            yield from _too_much(key, known.value, most, "kg m^2", strongest)


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
            f"{key} = {value:g} {unit}: far more than {with_article(joint.model)} can move ({most:.3g} {unit})"
            + (_meant(value, unit, most) or ". Use SI units for all quantities: kg, m, N m, rad, s")
        )


def _meant(value: float, unit: str, most: float, least: float = 0.0) -> str:
    """Return text such as ". If it is in mm, write 0.147" for the unit in which the value is plausible; "" if there is
    none.
    """
    hint = in_other_units(value, unit, lambda converted: least <= abs(converted) <= most)
    return f". {hint}" if hint else ""
