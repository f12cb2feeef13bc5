"""Checks of every joint in every exchange, in one compiled loop because there is little time between samples.

They check, in this order: jumps of the position, the limits of position and velocity, whether the motor carries the
commanded current (`following`), whether position and velocity agree (`consistency`), whether the motor turns as
commanded (`work`), and whether all readings are frozen although the goal changes (`following` again). Everything known
about a joint is in one record of type `JOINT`.
"""

from collections.abc import Callable
from struct import Struct
from typing import Any

import numpy as np

from hil.drivers.state import State
from hil.estimator.compiled import compiled, embedded, only_version
from hil.experiment.checks import consistency, following, work

FINE = -1
CHECKS = 7
JUMP, POSITION, VELOCITY, FOLLOWING, CONSISTENCY, WORK, FROZEN = range(CHECKS)

JUMP_ALLOWANCE_RAD = 0.01
"""Allowance for rounding and the noise of a worn encoder [rad]."""

FARTHER_OUT_RAD = 0.01
"""How much farther out a joint may move if an earlier run left it beyond its limit [rad]."""

MOST_OUTSIDE_RAD = 0.5
"""How far beyond its limit a joint may start if an earlier run left it there [rad]: a light arm may coast past the
limit.
"""

LONG_GAP = 3.0
"""If the gap between two samples is longer than this [sample intervals], the motion in between is too uncertain to
integrate.
"""

JOINT = np.dtype(
    [
        *((name, "f8") for name in ("low", "high", "fastest", "farthest")),
        *((name, "?") for name in ("may_start_outside", "is_followed", "is_worked")),
        *((name, "f8") for name in ("position", "seen_at", "found_outside")),
        *((name, "f8") for name in ("moved", "seconds", "most", "found")),
        ("following", following.MEMORY),
        ("goals", following.GOALS),
        ("consistency", consistency.MEMORY),
        ("work", work.MEMORY),
    ],
    align=True,
)
"""One joint: limits, latest state, what the latest check found, and the state that each check keeps.

low, high: position limits [rad]. fastest: velocity limit [rad/s]. farthest: fastest accepted change of a reported
position [rad/s]. may_start_outside, is_followed, is_worked: whether the joint may start outside its limits, and whether
`following` and `work` are checked. position, seen_at: latest position [rad], NaN before the first one, and its time
[s]. found_outside: first position seen, if outside the limits [rad], otherwise NaN. moved, seconds, most: change of
position [rad], the time that it represents [s], and the largest possible change [rad]. found: duration of a deviation
from the goal [s], or work taken out of the arm [J].
"""


class JointChecks:
    """The records of the joints, an array of type `JOINT`, and their latest sample.

    interval: time between two exchanges [s].
    """

    def __init__(self, joints: np.ndarray, interval: float) -> None:
        self.joints = joints
        self.interval = interval
        self._count = len(joints)
        self._sample = np.zeros((4, self._count))
        self._pack = Struct(f"{4 * self._count}d").pack_into
        self._bytes = memoryview(self._sample.data).cast("B")
        joints["position"] = joints["found_outside"] = np.nan
        for joint in joints:
            consistency.begin(joint["consistency"])
        _look(joints, self._sample, 0, 0, 0.0, 0.0, interval, 0.0, 0)  # compile
        self._check: Callable[..., int] = only_version(_look)

    def look(self, state: State, unsure: float) -> int:
        """Check all joints; each of them must have replied in this exchange and in the previous one.

        Returns FINE if every joint passes. Otherwise, returns CHECKS * joint + the number of the failed check, for the
        first joint that fails; later joints are not checked. unsure: excess duration of the exchange [s].
        """
        before, after, goal, current, velocity, position, _, _, _, _, _ = state
        self._pack(self._bytes, 0, *position, *velocity, *goal, *current)
        return self._check(self.joints, self._sample, 0, self._count, before, after, self.interval, unsure, 0)

    def look_at(self, joint: int, state: State, unsure: float, missed: int) -> int:
        """Check one joint, whose last `missed` replies were missing. Returns the same as `look`."""
        before, after, goal, current, velocity, position, _, _, _, _, _ = state
        self._pack(self._bytes, 0, *position, *velocity, *goal, *current)
        only = joint, joint + 1
        return self._check(self.joints, self._sample, *only, before, after, self.interval, unsure, missed)


def _may_be_outside(joint: Any, position: float) -> bool:
    """Whether a position outside the limits is accepted, because an earlier run left the joint there."""
    former = joint.position
    beyond = max(joint.low - position, position - joint.high)
    if np.isnan(former) and joint.may_start_outside and beyond <= MOST_OUTSIDE_RAD:
        joint.found_outside = position
    found = joint.found_outside
    if np.isnan(found) or joint.low <= former <= joint.high:
        return False
    return bool(min(joint.low, found - FARTHER_OUT_RAD) <= position <= max(joint.high, found + FARTHER_OUT_RAD))


def _fault(
    joints: Any,
    index: int,
    sample: Any,
    now: float,
    after: float,
    interval: float,
    unsure: float,
    missed: int,
) -> int:
    """Return the check that a joint fails, or FINE."""
    joint = joints[index]
    position, velocity, goal, current = sample[0, index], sample[1, index], sample[2, index], sample[3, index]
    elapsed = now - joint.seen_at
    former = joint.position
    is_first = np.isnan(former)
    # A punctual sample after a late one still represents a whole interval; nothing is known before the first one.
    seconds = interval * (1 + missed) if is_first else max(interval * (1 + missed), elapsed)
    if not is_first:
        joint.moved, joint.seconds = position - former, seconds
        joint.most = joint.farthest * (seconds + after - now) + JUMP_ALLOWANCE_RAD
        if not -joint.most <= joint.moved <= joint.most:
            return JUMP
    if not joint.low <= position <= joint.high and not _may_be_outside(joint, position):
        return POSITION
    if not -joint.fastest <= velocity <= joint.fastest:
        return VELOCITY
    joint.position, joint.seen_at = position, now
    stands = position == former and velocity == joint.consistency.velocity and missed == 0
    if joint.is_followed:
        joint.found = following.look(joint.following, goal, current, seconds)
        if joint.found >= 0.0:
            return FOLLOWING
    is_long = elapsed > LONG_GAP * interval
    if is_long:
        consistency.lost(joint.consistency)
    if consistency.look(joint.consistency, position, velocity, elapsed, unsure):
        return CONSISTENCY
    if joint.is_worked:
        # If other goals may have been in effect since the last sample, the work done is unknown.
        is_known = not is_first and elapsed < LONG_GAP * interval and missed == 0
        joint.found = work.look(joints, index, goal, joint.moved if is_known else 0.0)
        if joint.found >= 0.0:
            return WORK
    if joint.is_followed and following.is_frozen(joint.goals, goal, current, seconds, stands):
        return FROZEN
    return FINE


def _look_loop(
    joints: Any,
    sample: Any,
    first: int,
    end: int,
    now: float,
    after: float,
    interval: float,
    unsure: float,
    missed: int,
) -> int:
    for index in range(first, end):
        check = _fault(joints, index, sample, now, after, interval, unsure, missed)
        if check != FINE:
            return CHECKS * index + check
    return FINE


_may_be_outside, _fault = map(embedded, (_may_be_outside, _fault))
_look: Callable[..., int] = compiled(_look_loop)
