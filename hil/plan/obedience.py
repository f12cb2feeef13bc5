"""Detection of reversed motors while an arm is lowered: such a motor speeds its joint up instead of braking it.

As long as the torque does not change, a reversed motor and something that pushes the joint look alike: the arm moves as
if an additional torque acted on the joint. So the goal of such a joint is removed for a moment, while the others are
held. Unexplained torque that comes from the joint's own motor falls in proportion to its goal; torque from a push does
not. The test is short: in that time a limp joint gains less speed from gravity than a reversed motor would give it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["Obedience", "Residual"]

SUSPECT = 0.5, 5.0
"""Range of the ratio of unexplained to commanded torque that may indicate a reversed motor. Ideally the ratio is 2; it
is smaller just after the motor has become reversed, and larger if the commanded torque has just changed.
"""

ENOUGH = 0.45
"""A test is decided when the filtered torque has fallen to this fraction of its value at the beginning of the test."""

LONGEST_TEST_S = 0.06

TURNED, PUSHED = 1.1, 0.7
"""By how much the unexplained torque must fall, relative to the joint's own torque, when its goal is removed: 2 for a
reversed motor, less right after the reversal, 1 for a motor without torque, 0 for a push. Between the two limits, the
joint is tested again.
"""

MOVES_RAD_S = 0.1
PAUSE_S = 0.01


class Residual(NamedTuple):
    """Torque that the model does not explain, by joint (joints,).

    lacking: commanded torque minus the torque that explains the motion [N m]. torque: commanded torque [N m], filtered
    in the same way.
    suspected: whether `lacking` is larger than its uncertainty.
    """

    lacking: Sequence[float]
    torque: Sequence[float]
    suspected: Sequence[bool]


@dataclass
class _Test:
    """A joint without goal. since: its beginning [s]. drives: whether the unexplained torque made the joint faster."""

    since: float
    drives: bool
    lacking: float | None = None
    torque: float = 0.0


class Obedience:
    """Tests joints that move as if their motors were reversed. joints: number of joints of the arm."""

    def __init__(self, joints: int) -> None:
        self._tests: list[_Test | None] = [None] * joints
        self._rests_until = [float("-inf")] * joints
        self._pushed = [False] * joints

    def is_limp(self, joint: int) -> bool:
        """Whether this joint must receive no torque now."""
        return self._tests[joint] is not None

    def suspect(self, found: Residual, velocity: Sequence[float], now: float) -> None:
        """Begin the tests that the latest exchange calls for. velocity: believed velocities [rad/s]. now: time of that
        exchange [s].
        """
        for joint, (lacking, torque) in enumerate(zip(found.lacking, found.torque, strict=True)):
            if self._tests[joint] or self._pushed[joint] or now < self._rests_until[joint]:
                continue
            low, high = SUSPECT[0] * abs(torque), SUSPECT[1] * abs(torque)
            if found.suspected[joint] and lacking * torque > 0.0 and low <= abs(lacking) <= high:
                self._tests[joint] = _Test(now, _drives(lacking, velocity[joint]))

    def look(self, found: Residual, velocity: Sequence[float], now: float) -> int:
        """Process an exchange; return a joint whose motor is reversed, -1 if there is none."""
        for joint, test in enumerate(self._tests):
            if test is None:
                continue
            lacking, torque = found.lacking[joint], found.torque[joint]
            if test.lacking is None:  # the goal was taken away with this exchange
                test.lacking, test.torque = lacking, torque
                test.drives |= _drives(lacking, velocity[joint])
            elif abs(torque) <= ENOUGH * abs(test.torque) or now - test.since > LONGEST_TEST_S:
                share = (test.lacking - lacking) / (test.torque - torque) if torque != test.torque else 0.0
                # What slows a joint down may be an obstacle, whose force also ends with the goal.
                if test.drives and share > TURNED:
                    return joint
                self._tests[joint] = None
                self._rests_until[joint] = now + PAUSE_S
                self._pushed[joint] = share <= PUSHED
        self.suspect(found, velocity, now)
        return -1


def _drives(lacking: float, velocity: float) -> bool:
    """Whether the unexplained torque, -lacking, makes the joint faster."""
    return -lacking * velocity > 0.0 and abs(velocity) > MOVES_RAD_S
