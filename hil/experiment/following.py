"""Whether a motor carries the commanded current: judged by the current (or voltage) that each reply holds.

A servo may have lost its torque in the middle of a run: rebooted, stopped by its watchdog, switched off by another
program. Then its current is zero, whatever is commanded. How much current that takes from it depends on what is
played, not on how much the servo could carry, so everything here is measured against the planned peak.

Two hypotheses are compared on every sample, sequentially (E. S. Page, "Continuous inspection schemes", Biometrika 41
(1954) 100): the current is the one commanded, or it is zero. Their log likelihood ratio, for errors of standard
deviation sigma, grows by

    (distance from the commanded current)^2 - (distance from zero)^2, over 2 sigma^2

a sample, bounded both ways so that no single reply decides, and is not let below zero. Time counts, not samples: a
sample weighs as much as the time that it stands for. The commanded current is anything between the last two goals,
since a reply may be measured before or after the motor has followed the latest one.
"""

from typing import NamedTuple

from hil.config.joint import JointConfig

SIGMA_SHARE = 0.1
"""Of the planned peak: errors of sensor and current loop that are nothing out of the ordinary."""

SIGMA_TICKS = 4.0
"""The same in ticks of the register, where the planned peak is small."""

LOST_AFTER_S = 0.03
"""For how long a current must look like zero, at full weight, to be taken for it."""

_FULL_WEIGHT = 2.0
"""The log likelihood ratio of a sample that weighs most: a current of two sigma commanded, and none there."""

_FEWEST = 2
"""Samples that it takes at least, however slow the rate."""


class Unfollowed(NamedTuple):
    """A motor that does not carry the commanded value [A or V], for how long [s]."""

    goal: float
    carried: float
    seconds: float


class Following:
    """One joint's current against its goals. planned: largest goal of the plan [A, or V under PWM]."""

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
        """The latest goal, what the reply says is carried [A or V], and the time since the last reply."""
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
        # A stabiliser may ask for more than was planned.
        if off <= self._allowed or off <= self._share * abs(goal):
            self._differs_for, self._differs = 0.0, 0
            return None
        self._differs_for += seconds
        self._differs += 1
        if self._differs_for >= self._follow_time and self._differs >= _FEWEST:
            return Unfollowed(goal, carried, self._differs_for)
        return None
