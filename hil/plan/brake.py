"""Braking, the first stage of stopping an arm where possible: currents oppose the joints' velocities.

Braking is limited in time and stays within the current limits. It ends at once when a reply or deadline is
missed, a servo raises an alert, a second signal arrives, or a joint speeds up, as it does if its motor turns the wrong
way.

A joint is braked against its reported velocity only as far as the change of its position confirms that velocity
(`hil.plan.recent_motion`), so that no current acts in the direction of its actual motion.
"""

from hil.config.schema import Config
from hil.drivers.preparation.cadence import exchange_interval
from hil.drivers.servo_prior import servo_prior
from hil.drivers.state import State
from hil.errors import ExperimentError, SafetyStop
from hil.plan.recent_motion import RecentMotion

FULL_AT = 0.5
"""Fraction of the velocity limit at which the brake uses the full current limit.

A stronger brake stops the arm hardly any sooner, and throws it back farther if the connection is lost.
"""

LIGHTEST = 0.5
"""Smallest inertia that a joint is assumed to have, relative to the typical rotor inertia of its servo.

A light joint that is braked too hard would be moving backwards, faster than before, when its velocity is next read.
"""

DELAY_S = 0.002
"""Time until a goal takes effect [s]; a braking goal thus acts for the interval between exchanges plus this time."""

GETS_FASTER = 0.2
"""Braking is abandoned if the speed increases by this fraction of the velocity limit.

Some increase is normal: gravity and the other joint's brake act on the joint.
"""

STILL_FASTER, SLOWS_AFTER_S = 0.06, 0.02
"""The first value replaces `GETS_FASTER` once braking has lasted for the second one [s]. Without it, a reversed motor
could drive a joint that has a high velocity limit until braking ends.
"""

NOTICED_AFTER = 2
"""Number of samples for which a brake with the wrong sign acts before this is detected: one, plus the one in
progress.
"""


def may_brake(config: Config, error: BaseException) -> bool:
    """Whether this stop brakes before torque is cut: both the configuration and the cause must allow it."""
    if config.safety.stop == "cut" or not isinstance(error, ExperimentError):
        return False
    return error.cause.allows_braking if isinstance(error, SafetyStop) else True


def braking_gains(config: Config, interval: float | None = None) -> list[float]:
    """Braking gains [A s/rad, or V s/rad in PWM mode], low enough that no single goal reverses the motion of even the
    lightest joint.

    interval: time between two exchanges [s]; by default, the interval on a fast bus.
    """
    held = (exchange_interval(1.0 / config.experiment.rate) if interval is None else interval) + DELAY_S
    return [
        min(
            joint.goal_limit / (FULL_AT * joint.velocity_limit),
            LIGHTEST * servo_prior(joint.joint.servo).armature.median / (held * joint.torque_per_goal),
        )
        for joint in config.joints
    ]


class Brake:
    """Computes goal currents that oppose the joints' velocities.

    recent: the exchanges before the stop. Without these, a joint is braked only once two of its states are known.
    """

    def __init__(self, config: Config, interval: float | None = None, recent: RecentMotion | None = None) -> None:
        self._gains = braking_gains(config, interval)
        self._limits = [joint.goal_limit for joint in config.joints]
        self._fastest = [joint.velocity_limit for joint in config.joints]
        self._first_samples = SLOWS_AFTER_S * config.experiment.rate if interval is None else SLOWS_AFTER_S / interval
        self._samples = 0
        self._enough = config.safety.rest_velocity
        self._recent = RecentMotion(config, interval) if recent is None else recent
        self._first: tuple[list[float], list[float]] | None = None

    def goals(self, state: State) -> list[float] | None:
        """Goal currents [A] for this sample; None if braking is over because the arm is at rest, a reply is missing, or
        a joint accelerates.
        """
        velocities = self._recent.believed(state)
        speeds = [abs(velocity) for velocity in state.velocity]
        if any(state.missing) or any(state.error) or all(speed < self._enough for speed in speeds):
            return None
        if self._pushes(speeds, self._recent.speeds()):
            return None
        return [
            max(-limit, min(limit, -gain * velocity))
            for gain, limit, velocity in zip(self._gains, self._limits, velocities, strict=True)
        ]

    def _pushes(self, reported: list[float], visible: list[float]) -> bool:
        """Whether a joint is clearly faster than when braking began, according to its reported velocity or its change
        of position.
        """
        if self._first is None:
            self._first = reported, visible
        share = GETS_FASTER if self._samples < self._first_samples else STILL_FASTER
        self._samples += 1
        return any(
            now > first + share * fastest
            for speeds, begun in zip((reported, visible), self._first, strict=True)
            for now, first, fastest in zip(speeds, begun, self._fastest, strict=True)
        )
