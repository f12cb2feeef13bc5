"""The first part of a stop, where it is possible: brake, that is, a current against each joint's velocity.

For a bounded time and within the current limits; over at once when a reply is missing, a servo alerts, a deadline is
missed or a second signal comes. Torque is cut after it in any case.
"""

from drivers.state import State
from hil.config import Config
from hil.errors import ExperimentError, SafetyStop

FULL_AT = 0.2
"""Share of the velocity limit at which the brake uses the whole current limit."""


def may_brake(config: Config, error: BaseException) -> bool:
    """Whether this stop brakes before torque is cut: configuration and cause must both allow it."""
    if config.safety.stop == "cut" or not isinstance(error, ExperimentError):
        return False
    return error.cause.allows_braking if isinstance(error, SafetyStop) else True


def braking_gains(config: Config) -> list[float]:
    """A per rad/s, per joint."""
    return [joint.goal_limit / (FULL_AT * joint.velocity_limit) for joint in config.joints]


class Brake:
    """Goal currents against the measured velocities."""

    def __init__(self, config: Config) -> None:
        self._gains = braking_gains(config)
        self._limits = [joint.goal_limit for joint in config.joints]
        self._enough = config.safety.rest_velocity

    def goals(self, state: State) -> list[float] | None:
        """Goal currents [A] for this sample; None when braking is over: at rest, or a joint cannot be felt."""
        if any(state.missing) or any(state.error) or all(abs(velocity) < self._enough for velocity in state.velocity):
            return None
        return [
            max(-limit, min(limit, -gain * velocity))
            for gain, limit, velocity in zip(self._gains, self._limits, state.velocity, strict=True)
        ]
