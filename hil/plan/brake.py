"""The first part of a stop, if possible: braking, with a current opposing each joint's velocity.

Braking lasts a bounded time, within the current limits. It ends at once when a reply is missing, a servo raises an
alert, a deadline is missed, a second signal arrives, or a joint accelerates, as it does if its motor turns the wrong
way. Torque is cut afterwards in any case.
"""

from hil.config.schema import Config
from hil.drivers.preparation.cadence import CHECK_S
from hil.drivers.servo_prior import servo_prior
from hil.drivers.state import State
from hil.errors import ExperimentError, SafetyStop

FULL_AT = 0.5
"""Fraction of the velocity limit at which the brake uses the full current limit.

A stronger brake hardly stops sooner, and throws the arm back much farther if the connection is lost during braking.
"""

LIGHTEST = 0.5
"""Smallest inertia that a joint is assumed to have, relative to the typical rotor inertia of its servo.

A light joint that is braked too hard is thrown back faster than it came before its velocity is read again.
"""

DELAY_S = 0.002
"""Time until a goal takes effect [s]; a braking goal thus acts for the interval between exchanges plus this time."""

GETS_FASTER = 0.2
"""Increase in speed, relative to the velocity limit, at which braking is abandoned.

Some increase is normal: gravity and the other joint's brake act on the joint.
"""

NOTICED_AFTER = 2
"""Samples for which a brake of the wrong sign acts before it is noticed: one sample, and one in progress."""


def may_brake(config: Config, error: BaseException) -> bool:
    """Whether this stop brakes before torque is cut: both the configuration and the cause must allow it."""
    if config.safety.stop == "cut" or not isinstance(error, ExperimentError):
        return False
    return error.cause.allows_braking if isinstance(error, SafetyStop) else True


def braking_gains(config: Config, interval: float | None = None) -> list[float]:
    """Braking gains [A s/rad, or V s/rad in PWM mode] with which no single goal reverses the lightest joint.

    interval: time between two exchanges [s]; by default, that on a fast bus.
    """
    sample = 1.0 / config.experiment.rate
    held = (sample / max(1, int(sample / CHECK_S + 1e-6)) if interval is None else interval) + DELAY_S
    return [
        min(
            joint.goal_limit / (FULL_AT * joint.velocity_limit),
            LIGHTEST * servo_prior(joint.joint.servo).armature.median / (held * joint.torque_per_goal),
        )
        for joint in config.joints
    ]


class Brake:
    """Computes goal currents that oppose the measured velocities."""

    def __init__(self, config: Config, interval: float | None = None) -> None:
        self._gains = braking_gains(config, interval)
        self._limits = [joint.goal_limit for joint in config.joints]
        self._allowed = [GETS_FASTER * joint.velocity_limit for joint in config.joints]
        self._enough = config.safety.rest_velocity
        self._first: list[float] | None = None

    def goals(self, state: State) -> list[float] | None:
        """Goal currents [A] for this sample; None if braking is over: arm at rest, reply missing, or a joint
        accelerates.
        """
        speeds = [abs(velocity) for velocity in state.velocity]
        if any(state.missing) or any(state.error) or all(speed < self._enough for speed in speeds):
            return None
        if self._pushes(speeds):
            return None
        return [
            max(-limit, min(limit, -gain * velocity))
            for gain, limit, velocity in zip(self._gains, self._limits, state.velocity, strict=True)
        ]

    def _pushes(self, speeds: list[float]) -> bool:
        """Whether a joint is clearly faster than when braking began."""
        if self._first is None:
            self._first = speeds
        return any(now > first + more for now, first, more in zip(speeds, self._first, self._allowed, strict=True))
