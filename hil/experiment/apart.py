"""Check that the servos of one joint turn together.

Two servos on one joint are coupled by their horns. A horn that slips, a loose screw or a broken gear lets one of them
turn without the other, which the joint's angle, taken from the first servo, does not show. The difference between their
angles is compared with what it was at the first sample, because horns are mounted at any angle.
"""

from collections.abc import Sequence
from math import isnan

ALLOWED_RAD = 0.1
"""Tolerance for backlash of two gear trains, encoder nonlinearity, and twist of the joint between its servos."""


class Apart:
    """Compares the other servos of each joint with its first one."""

    def __init__(self) -> None:
        self._first: dict[tuple[int, int], float] = {}

    def look(self, apart: Sequence[Sequence[float]]) -> tuple[int, int, float] | None:
        """Process a sample; return joint, additional servo (both from 0) and change [rad] if they no longer agree.

        apart: angles of each joint's other servos minus the first's [rad], NaN if one did not reply.
        """
        for joint, differences in enumerate(apart):
            for servo, difference in enumerate(differences):
                if isnan(difference):
                    continue
                changed = difference - self._first.setdefault((joint, servo), difference)
                if abs(changed) > ALLOWED_RAD:
                    return joint, servo, changed
        return None
