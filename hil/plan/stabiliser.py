"""A software spring and damper for arms without a stable rest pose: horizontal or inverted.

The estimator receives the torque that was actually commanded, including spring and damper.
"""

from math import ceil

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.state import State
from hil.errors import ConfigError
from hil.estimator.arrays import Array
from hil.estimator.simulation.closed_loop import Feedback
from hil.plan.chain_rate import chain_too_slow
from hil.plan.drive_prior import low_viscous
from hil.results.parts import StabiliserShare

DELAY_SAMPLES = 1.5
"""Mean age of the state on which a torque is based [samples]: the state is one sample old when the torque is sent, and
the torque is held for another sample.
"""

MOST_DRIVEN = 0.8
"""Largest fraction of a joint's damping that the delay of its spring may cancel."""

_ROUNDED = 1.01
"""Tolerance for gains that were chosen for `MOST_DRIVEN` and then rounded."""

INTEGRAL_TIME_S = 1.0
"""Time after which the integral of a constant deviation adds as much current as the spring [s]."""

BALANCED_RAD = 0.02
"""Deviation from the rest pose below which the integral stops growing [rad]: friction can hold an arm that is this
close to its rest pose.
"""


def must_balance(config: Config) -> bool:
    """Whether gravity drives the arm away from its rest pose: once torque is off, only friction holds it there."""
    above = np.sin(np.cumsum(config.arm.rest_pose)) > 0.0
    return config.stabiliser is not None and not config.is_chain and config.arm.gravity > 0.0 and bool(above.any())


class Stabiliser:
    """Adds spring and damper currents to a goal. A joint whose reply is missing keeps its previous contribution."""

    def __init__(self, config: Config) -> None:
        assert config.stabiliser is not None
        self._gains = [
            (stiffness / joint.torque_per_goal, damping / joint.torque_per_goal, pose)
            for joint, stiffness, damping, pose in zip(
                config.joints,
                config.stabiliser.stiffness,
                config.stabiliser.damping,
                config.arm.rest_pose,
                strict=True,
            )
        ]
        self._added = [0.0] * len(self._gains)
        self._integral: list[float] | None = None
        self._share = 1.0 / (INTEGRAL_TIME_S * config.experiment.rate)

    def balance(self) -> None:
        """From now on, add integral currents that bring the arm to its rest pose against friction and gravity."""
        self._integral = [0.0] * len(self._gains)

    @staticmethod
    def is_balanced(config: Config, state: State) -> bool:
        """Whether every joint is close enough to its rest pose for friction to hold it there."""
        away = zip(state.position, config.arm.rest_pose, strict=True)
        return all(abs(position - pose) <= BALANCED_RAD for position, pose in away)

    def add(self, goal: list[float], former: State | None) -> list[float]:
        """Goal currents [A] with the stabiliser's contribution added. former: the latest sample before this command."""
        if former is None:
            return goal
        added, integral = self._added, self._integral
        for index, (spring, damper, pose) in enumerate(self._gains):
            if not former.missing[index]:
                away = pose - former.position[index]
                added[index] = spring * away - damper * former.velocity[index]
                if integral is not None:
                    if abs(away) > BALANCED_RAD:
                        integral[index] += self._share * spring * away
                    added[index] += integral[index]
        return [wanted + more for wanted, more in zip(goal, added, strict=True)]


def too_slow(config: Config) -> str:
    """Explain why the rate is too low for the stabiliser, and what to do; "" if it is high enough.

    A spring whose torque is delayed by `delay` acts like negative damping of magnitude stiffness times `delay`. The
    joint oscillates unless this is outweighed by the configured damping together with the smallest viscous friction to
    be expected of its servos. Part of the damping must remain, because the damper is delayed too and the joints are
    coupled. For a spatial arm, whose masses are known from its description, the control loop itself is analysed.
    """
    if config.stabiliser is None:
        return ""
    if config.is_chain:
        return chain_too_slow(config)
    delay = DELAY_SAMPLES / config.experiment.rate
    stiffness, damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
    damps = damping + low_viscous(config)
    shares = delay * stiffness / damps
    worst = int(np.argmax(shares))
    if shares[worst] <= _ROUNDED * MOST_DRIVEN:
        return ""
    return (
        f"experiment.rate = {config.experiment.rate:g} is too low for the stabiliser of joint "
        f"{config.joints[worst].name!r}: its torque is based on a state {1e3 * delay:.0f} ms old. A stiffness of "
        f"{stiffness[worst]:g} N m/rad then acts like a damping of -{delay * stiffness[worst]:.2g} N m s/rad, but the "
        f"stabiliser and friction together provide a damping of only {damps[worst]:.2g}, of which at most "
        f"{100 * MOST_DRIVEN:.0f} % may be cancelled. Raise the rate to at least "
        f"{ceil(config.experiment.rate * shares[worst] / MOST_DRIVEN)} Hz, lower stabiliser.stiffness, or raise "
        "stabiliser.damping."
    )


def check_rate(config: Config) -> None:
    """Raise ConfigError if the rate is too low for the stabiliser."""
    if why := too_slow(config):
        raise ConfigError(f"{config.path}: {why}")


def feedback_of(config: Config) -> Feedback:
    """The configured stabiliser and the torque limits [N m]; without a stabiliser, the gains are zero."""
    limit = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
    pose = np.array(config.arm.rest_pose)
    if config.stabiliser is None:
        return Feedback(np.zeros_like(pose), np.zeros_like(pose), pose, limit)
    return Feedback(np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping), pose, limit)


def stabiliser_share(config: Config, samples: NDArray[np.void]) -> StabiliserShare:
    """The stabiliser's contribution to the torque in consecutive rows recorded during one multisine."""
    torque = feedback_torque(config, samples)
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    commanded = samples["goal_current"][1:] * constants
    return StabiliserShare(
        tuple(np.sqrt(np.nanmean(torque**2, axis=0)).tolist()),
        tuple(np.nanmax(np.abs(torque), axis=0).tolist()),
        tuple(np.sqrt(np.mean(commanded**2, axis=0)).tolist()),
    )


def feedback_torque(config: Config, samples: NDArray[np.void]) -> Array:
    """The stabiliser's torque in all rows but the first (rows - 1, joints) [N m]; NaN where a reply is missing."""
    assert config.stabiliser is not None
    stiffness, damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
    position: Array = samples["position"][:-1]
    velocity: Array = samples["velocity"][:-1]
    return stiffness * (np.array(config.arm.rest_pose) - position) - damping * velocity
