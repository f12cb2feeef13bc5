"""The first part of a stop, where possible: braking, with a current opposing each joint's velocity.

For a bounded time and within the current limits; over at once when a reply is missing, a servo alerts, a deadline is
missed, a second signal comes, or a joint gets faster instead of slower, as one does whose motor turns the wrong way.
Torque is cut after it in any case.
"""

from hil.config.schema import Config
from hil.drivers.state import State
from hil.errors import ExperimentError, SafetyStop

FULL_AT = 0.5
"""Share of the velocity limit at which the brake uses the whole current limit. A fiercer one stops hardly sooner, and
throws the arm back much farther where the connection is lost while it brakes.
"""


GETS_FASTER = 0.2
"""Share of the velocity limit by which a joint may get faster than it was before the brake is given up: gravity and its
neighbour's brake pull at it.
"""

NOTICED_AFTER = 2
"""Samples for which a brake that pushes acts before the sample that shows it, once it shows: one, and one under way."""


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
        self._allowed = [GETS_FASTER * joint.velocity_limit for joint in config.joints]
        self._enough = config.safety.rest_velocity
        self._first: list[float] | None = None

    def goals(self, state: State) -> list[float] | None:
        """Goal currents [A] for this sample; None when it is over: at rest, a joint cannot be felt, or it pushes."""
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
        """Whether a joint is faster than when the braking began."""
        if self._first is None:
            self._first = speeds
        return any(now > first + more for now, first, more in zip(speeds, self._first, self._allowed, strict=True))
