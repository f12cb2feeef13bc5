"""Check that a motor carries the commanded current, by the current (or voltage) reported in each reply.

A servo may lose its torque in the middle of a run: it rebooted, was stopped by its watchdog, or was switched off by
another program. Its current is then zero, whatever is commanded. How much current is missing depends on the plan,
not on what the servo could carry, so all thresholds are relative to the planned peak.

Two hypotheses are compared on every sample, sequentially (E. S. Page, "Continuous inspection schemes", Biometrika 41
(1954) 100): the current is the one commanded, or it is zero. Their log likelihood ratio, for errors of standard
deviation sigma, grows by

    [(distance from the commanded current)^2 - (distance from zero)^2] / (2 sigma^2)

per sample. The step is bounded so that no single reply decides, and the sum is kept at or above zero. Each sample is
weighted by the time that it represents. The commanded current is any value between the last two goals,
because a reply may be measured before or after the motor follows the latest goal.
"""

from typing import NamedTuple

from hil.config.joint import JointConfig

SIGMA_SHARE = 0.1
"""Standard deviation of ordinary sensor and current-loop errors, relative to the planned peak."""

SIGMA_TICKS = 4.0
"""The same in register ticks; used if it is larger than that of SIGMA_SHARE."""

LOST_AFTER_S = 0.03
"""Time for which a current must look like zero, at full weight, before it is taken for zero [s]."""

_FULL_WEIGHT = 2.0
"""Largest log likelihood ratio of one sample: a commanded current of two sigma, and a measured one of zero."""

_FEWEST = 2
"""Minimum number of samples, however low the rate."""


class Unfollowed(NamedTuple):
    """A motor that does not carry the commanded value: goal and measured value [A or V], and duration [s]."""

    goal: float
    carried: float
    seconds: float


class Following:
    """Compares one joint's current with its goals. planned: largest goal of the plan [A, or V under PWM]."""

    def __init__(self, joint: JointConfig, planned: float, follow_share: float, follow_time: float) -> None:
        tick = abs(joint.joint.drive_unit(12.0))
        sigma = max(SIGMA_SHARE * planned, SIGMA_TICKS * tick)
        self._per_square = 0.5 / sigma**2
        self._allowed = max(follow_share * planned, SIGMA_TICKS * tick)
        self._share = follow_share
        self._follow_time = follow_time
        self._former_goal = 0.0
        self._evidence = 0.0
        self._count = 0
        self._differs_for = 0.0
        self._differs = 0

    def look(self, goal: float, carried: float, seconds: float) -> Unfollowed | None:
        """Process a reply; return the deviation once it has lasted too long.

        goal: latest goal [A or V]. carried: measured value in the reply [A or V]. seconds: time since the last reply
        [s].
        """
        former, self._former_goal = self._former_goal, goal
        low, high = (goal, former) if goal < former else (former, goal)
        off = low - carried if carried < low else carried - high if carried > high else 0.0
        gain = (off * off - carried * carried) * self._per_square
        if gain > _FULL_WEIGHT:
            gain = _FULL_WEIGHT
        elif gain < -_FULL_WEIGHT:
            gain = -_FULL_WEIGHT
        evidence = self._evidence + gain * seconds
        if evidence > 0.0:
            self._evidence = evidence
            self._count += 1
            if evidence >= _FULL_WEIGHT * LOST_AFTER_S and self._count >= _FEWEST:
                return Unfollowed(goal, carried, self._count * seconds)
        else:
            self._evidence = 0.0
            self._count = 0
        # A stabiliser may command more than was planned.
        if off <= self._allowed or off <= self._share * abs(goal):
            self._differs_for, self._differs = 0.0, 0
            return None
        self._differs_for += seconds
        self._differs += 1
        if self._differs_for >= self._follow_time and self._differs >= _FEWEST:
            return Unfollowed(goal, carried, self._differs_for)
        return None
