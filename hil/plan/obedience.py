"""Detection of reversed motors while an arm is being lowered: such a motor speeds its joint up instead of braking it.

While the torque is constant, a reversed motor cannot be distinguished from an external push: in both cases, the arm
moves as if an additional torque acted on the joint. The goal of a suspect joint is therefore removed briefly, while the
other goals are held. Unexplained torque that comes from the joint's own motor then falls in proportion to the motor's
torque, through the same filter; torque from a push does not. If the unexplained torque falls earlier or later than the
motor's torque, the joint is tested again. The test is so short that an unpowered joint gains less speed from gravity
than a reversed motor would give it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

__all__ = ["Obedience", "Residual"]

SUSPECT = 0.5, 5.0
"""The motor may be reversed if the ratio of unexplained to commanded torque is in this range. Ideally, the ratio is 2;
it is smaller just after the motor has become reversed, and larger if the commanded torque has just changed.
"""

ENOUGH = 0.45
"""A test is decided when the filtered torque has fallen to this fraction of its value at the beginning of the test."""

LONGEST_TEST_S = 0.06

TURNED, PUSHED = 1.1, 0.7
"""Limits on the drop in the unexplained torque when the joint's goal is removed, relative to the drop in the joint's
own torque. This ratio is 2 for a reversed motor (less right after the reversal), 1 for a motor without torque, and 0
for a push. Above the first limit, the motor counts as reversed; up to the second, the joint counts as pushed; in
between, the joint is tested again.
"""

MOST_TURNED = 3.0
"""Ratio of drops, as in `TURNED`, above which the unexplained torque did not come from the joint's motor alone."""

UNEVEN = 0.3
"""Largest deviation of the unexplained torque from a drop in proportion to the joint's own torque, relative to the
total drop; a larger deviation shows that the unexplained torque has another cause.
"""

MOST_UNEVEN = 3
"""If the unexplained torque falls unevenly in this many consecutive tests, it is nevertheless attributed to the
motor.
"""

MOVES_RAD_S = 0.1
DOUBT_S = 0.1
"""Time after an inconclusive test during which a joint that speeds up counts as reversed without another test [s]: its
motor may have become reversed right before that test.
"""

PAUSE_S, PUSHED_PAUSE_S = 0.01, 0.25
"""Time between two tests of a joint, and waiting time after a test that showed a push [s]."""


class Residual(NamedTuple):
    """How far the model explains the torque of each joint (joints,).

    lacking: commanded torque minus the torque that explains the motion [N m]. torque: commanded torque [N m], filtered
    in the same way.
    suspected: whether `lacking` is larger than its uncertainty.
    """

    lacking: Sequence[float]
    torque: Sequence[float]
    suspected: Sequence[bool]


@dataclass
class _Test:
    """A test of a joint, during which its goal is removed.

    since: time at which it began [s]. drives: whether the unexplained torque accelerated the joint.
    """

    since: float
    drives: bool
    lacking: float | None = None
    torque: float = 0.0
    seen: list[tuple[float, float]] = field(default_factory=list)

    def share(self, lacking: float, torque: float) -> float:
        """Drop in the unexplained torque, relative to the drop in the joint's own torque."""
        assert self.lacking is not None
        return (self.lacking - lacking) / (self.torque - torque) if torque != self.torque else 0.0

    def is_uneven(self, lacking: float, torque: float) -> bool:
        """Whether the unexplained torque has not dropped in proportion to the joint's own torque."""
        assert self.lacking is not None
        share, most = self.share(lacking, torque), UNEVEN * abs(self.lacking - lacking)
        return share > MOST_TURNED or any(
            abs(self.lacking - before - share * (self.torque - own)) > most for before, own in self.seen
        )


class Obedience:
    """Tests joints that move as if their motors were reversed. joints: number of joints of the arm."""

    def __init__(self, joints: int) -> None:
        self._tests: list[_Test | None] = [None] * joints
        self._rests_until = [float("-inf")] * joints
        self._pushed = [False] * joints
        self._uneven = [0] * joints
        self._doubted_until = [float("-inf")] * joints

    def is_limp(self, joint: int) -> bool:
        """Whether this joint must receive no torque now."""
        return self._tests[joint] is not None

    def is_pushed(self, joint: int) -> bool:
        """Whether a test has shown that something is pushing, or has pushed, this joint."""
        return self._pushed[joint]

    def question(self, joint: int, now: float) -> bool:
        """Begin a test of a joint that speeds up although its torque opposes the motion. now: time [s].

        Returns False if a test has just been inconclusive, in which case the motor counts as reversed.
        """
        if now < self._doubted_until[joint]:
            return False
        if not self._tests[joint] and now >= self._rests_until[joint]:
            self._tests[joint] = _Test(now, drives=True)
        return True

    def suspect(self, found: Residual, velocity: Sequence[float], now: float) -> None:
        """Begin the tests that the latest exchange requires. velocity: trusted velocities [rad/s]. now: time of that
        exchange [s].
        """
        for joint, (lacking, torque) in enumerate(zip(found.lacking, found.torque, strict=True)):
            if self._tests[joint] or now < self._rests_until[joint]:
                continue
            low, high = SUSPECT[0] * abs(torque), SUSPECT[1] * abs(torque)
            if found.suspected[joint] and lacking * torque > 0.0 and low <= abs(lacking) <= high:
                self._tests[joint] = _Test(now, _drives(lacking, velocity[joint]))

    def look(self, found: Residual, velocity: Sequence[float], now: float) -> int:
        """Process an exchange; return the index of a joint whose motor is reversed, or -1 if there is none."""
        for joint, test in enumerate(self._tests):
            if test is None:
                continue
            lacking, torque = found.lacking[joint], found.torque[joint]
            if test.lacking is None:  # this exchange removed the goal
                test.lacking, test.torque = lacking, torque
                test.drives |= _drives(lacking, velocity[joint])
            elif abs(torque) <= ENOUGH * abs(test.torque) or now - test.since > LONGEST_TEST_S:
                # What slows a joint down may be an obstacle, whose force also ends with the goal.
                if test.drives and self._is_turned(joint, test, lacking, torque):
                    return joint
                self._tests[joint] = None
                is_pushed = test.share(lacking, torque) <= PUSHED
                self._pushed[joint] |= is_pushed
                if test.drives and not is_pushed and not test.is_uneven(lacking, torque):
                    self._doubted_until[joint] = now + DOUBT_S
                self._rests_until[joint] = now + (PUSHED_PAUSE_S if is_pushed else PAUSE_S)
            else:
                test.seen.append((lacking, torque))
        self.suspect(found, velocity, now)
        return -1

    def _is_turned(self, joint: int, test: _Test, lacking: float, torque: float) -> bool:
        """Whether a test that ends with these torques shows that the motor is reversed."""
        if test.share(lacking, torque) <= TURNED:
            return False
        is_uneven = test.is_uneven(lacking, torque)
        self._uneven[joint] += is_uneven
        return not is_uneven or self._uneven[joint] >= MOST_UNEVEN


def _drives(lacking: float, velocity: float) -> bool:
    """Whether the unexplained torque (the negative of `lacking`) accelerates the joint."""
    return -lacking * velocity > 0.0 and abs(velocity) > MOVES_RAD_S
