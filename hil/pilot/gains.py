"""Gains of a software spring and damper for an arm that does not return to its rest pose: horizontal, upright, or with
so much friction that gravity cannot move a joint.

The spring is stiff enough to outweigh gravity in nearly every plausible arm and to overcome friction at a deflection of
less than a radian. It is soft enough to leave most of the torque for the excitation.

At a low sample rate, such a spring would act so late that the joint would oscillate (`hil.plan.stabiliser`). The damper
is then made stronger and the spring softer, as far as rate and gravity allow.
"""

from math import ceil
from typing import NoReturn

import numpy as np

from hil.config.schema import Config, StabiliserConfig
from hil.errors import ConfigError
from hil.estimator.arrays import Array, Mask
from hil.pilot.belief import Belief
from hil.plan.drive_prior import low_viscous
from hil.plan.gains import MOST_DAMPING, most_damping
from hil.plan.stabiliser import DELAY_SAMPLES, MOST_DRIVEN

_FREQUENCY = 0.7  # Hz, natural frequency of each joint on its own spring
_DAMPING_RATIO = 0.35
_OUTWEIGHS = 1.3  # relative to the largest destabilising gravity stiffness of all arms
_FRICTIONS_PER_RADIAN = 1.5
_HELD = 1.5  # friction over gravity's torque at one radian from rest: at 1 it holds the joint at any angle
_TORQUE_SHARE = 0.35  # largest share of the torque limit at a deflection of 1 rad, beyond what gravity needs


def wandering(config: Config, belief: Belief) -> Mask:
    """Joints that need a spring (joints,): all joints if the arm falls over or lies flat, otherwise those that friction
    holds.
    """
    arm = belief.middle
    stiffness = gravity_stiffness(config, arm)
    if float(np.linalg.eigvalsh(stiffness).min()) <= 0.0:
        return np.ones(len(stiffness), dtype=np.bool_)
    friction = [arm[f"coulomb_{j + 1}"] * (1.0 + arm[f"stribeck_rise_{j + 1}"]) for j in range(len(stiffness))]
    return np.asarray(np.array(friction) > _HELD * np.diag(stiffness))


def falls_over(config: Config, belief: Belief) -> bool:
    """Whether gravity drives the median arm away from its rest pose, so that only a person can bring it back."""
    lowest = float(np.linalg.eigvalsh(gravity_stiffness(config, belief.middle)).min())
    return bool(config.arm.gravity) and lowest <= 0.0


def with_stabiliser(config: Config, belief: Belief, springs: Mask | None = None) -> Config:
    """Add gains to a configuration that needs a stabiliser and has none.

    springs: joints that get a spring in any case (joints,).
    """
    at = wandering(config, belief) if springs is None else springs | wandering(config, belief)
    if config.stabiliser is not None or not at.any():
        return config
    return config.model_copy(update={"stabiliser": proposed(config, belief, at)})


def proposed(config: Config, belief: Belief, springs: Mask) -> StabiliserConfig:
    """Gains suitable for the arms of `belief`; 0 for joints without a spring."""
    parameters = belief.parameters
    away = np.max([_pull_away(config, each) for each in parameters], axis=0)
    inertia = np.median([_inertia(config, each) for each in parameters], axis=0)
    friction, viscous = (np.median(_per_joint(config, parameters, name), axis=0) for name in ("coulomb", "viscous"))
    limit = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
    # Two coupled joints on such springs oscillate more slowly than each would alone; gravity is added.
    spring = np.maximum(inertia * (2 * np.pi * _FREQUENCY) ** 2, _FRICTIONS_PER_RADIAN * friction)
    stiffness = _OUTWEIGHS * away + np.minimum(spring, _TORQUE_SHARE * limit)
    damping = np.maximum(2 * _DAMPING_RATIO * np.sqrt(stiffness * inertia) - viscous, 0.0)
    low = low_viscous(config)
    lightest = np.min([_free_inertia(config, each) for each in parameters], axis=0)
    stiffness, damping = np.where(springs, stiffness, 0.0), np.where(springs, damping, 0.0)
    least = np.where(springs, _OUTWEIGHS * away, 0.0)
    spring, damper = _at_rate(config.experiment.rate, stiffness, damping, low, lightest)
    if (weak := spring < least).any():
        rate = float(_sufficient_rates(damping, least, low, lightest).max())
        _refuse_rate(config, int(np.argmax(weak)), away, np.ceil(rate))
    return StabiliserConfig(stiffness=_rounded(spring), damping=_rounded(damper))


def _at_rate(rate: float, stiffness: Array, damping: Array, friction: Array, lightest: Array) -> tuple[Array, Array]:
    """Return stiffness and damping for a sample rate [Hz]: as given, or with a stronger damper and, if necessary, a
    softer spring.

    friction: least expected viscous friction (joints,) [N m s/rad]. lightest: smallest inertia (joints,) [kg m^2].
    """
    delay = DELAY_SAMPLES / rate
    needed = delay * stiffness / MOST_DRIVEN - friction
    damping = np.maximum(damping, np.minimum(needed, most_damping(rate, lightest)))
    return np.minimum(stiffness, MOST_DRIVEN * (damping + friction) / delay), damping


def _sufficient_rates(damping: Array, least: Array, friction: Array, lightest: Array) -> Array:
    """Return each joint's lowest rate (joints,) [Hz] at which `_at_rate` gives the stiffness that gravity requires."""
    product = DELAY_SAMPLES * least / MOST_DRIVEN  # of rate and damping
    grown = MOST_DAMPING * lightest  # damping per rate
    root = np.sqrt(friction**2 + 4.0 * grown * product)
    return np.asarray(np.minimum((root - friction) / (2.0 * grown), product / (damping + friction)))


def _refuse_rate(config: Config, index: int, away: Array, rate: float) -> NoReturn:
    raise ConfigError(
        f"{config.path}: experiment.rate = {config.experiment.rate:g} is too low to hold joint "
        f"{config.joints[index].name!r}: in some of the possible arms, gravity drives it away from its rest pose with "
        f"{away[index]:.2g} N m/rad, and a spring that outweighs this would make the joint oscillate, because it acts "
        f"{1e3 * DELAY_SAMPLES / config.experiment.rate:.0f} ms late. Set experiment.rate to at least {ceil(rate)}."
    )


def gravity_stiffness(config: Config, parameters: dict[str, float]) -> Array:
    """Restoring torque of gravity per angle from the rest pose (joints, joints) [N m/rad]."""
    pose = np.array(config.arm.rest_pose)
    first = -parameters["gravity_1"] * np.sin(pose[0])
    if len(pose) == 1:
        return np.array([[first]])
    second = -parameters["gravity_2"] * np.sin(pose.sum())
    return np.array([[first + second, second], [second, second]])


def _pull_away(config: Config, parameters: dict[str, float]) -> Array:
    """Stiffness per joint (joints,) [N m/rad] that just outweighs gravity, coupling included."""
    away: Array = np.maximum(-gravity_stiffness(config, parameters), 0.0).sum(axis=1)
    return away


def _inertia(config: Config, parameters: dict[str, float]) -> Array:
    """Inertia of each joint in the rest pose (joints,) [kg m^2]."""
    if len(config.joints) == 1:
        return np.array([parameters["inertia_1"]])
    coupling = parameters["coupling"] * np.cos(config.arm.rest_pose[1])
    first = parameters["inertia_1"] + parameters["inertia_2"] + 2 * coupling
    return np.array([first, parameters["inertia_2"] + parameters["armature_2"]])


def _free_inertia(config: Config, parameters: dict[str, float]) -> Array:
    """Inertia of each joint (joints,) [kg m^2] in the rest pose, with the other joint free to move."""
    held = _inertia(config, parameters)
    if len(held) == 1:
        return held
    shared = parameters["inertia_2"] + parameters["coupling"] * np.cos(config.arm.rest_pose[1])
    return np.asarray(held - shared**2 / held[::-1])


def _per_joint(config: Config, parameters: list[dict[str, float]], name: str) -> Array:
    return np.array([[each[f"{name}_{j + 1}"] for j in range(len(config.joints))] for each in parameters])


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values]
