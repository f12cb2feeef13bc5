"""Check that the servos of one joint turn together.

A horn that slips, a loose screw or a broken gear lets one servo turn without the other. The joint's angle, taken from
the first servo, does not show this. The difference between the servos' angles is compared with its value at the first
sample, because horns may be mounted at any angle.
"""

from collections.abc import Sequence
from math import isnan

from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode

ALLOWED_RAD = 0.1
"""Largest accepted change of the difference between the angles of two servos [rad]. It allows for backlash in both gear
trains, encoder nonlinearity, and twist of the joint between the servos.
"""


def opposed(joint: Joint) -> str:
    """Return text asking whether the joint's two servos work against each other; "" if it has only one servo."""
    if not joint.seconds:
        return ""
    signs = [joint.direction, *(second.direction for second in joint.seconds)]
    return f"its two servos work against each other: is one entry of direction = {signs} wrong?"


def without_torque(joint: Joint) -> str:
    """Explain why a joint may receive no torque although no fault is reported.

    A broken wire or winding is visible in the motor current, which the guard compares with its goal, but not in the
    applied voltage or the supply current.
    """
    if joint.mode is Mode.CURRENT and not joint.servo.senses_supply:
        return "its gear does not transmit the motor's torque"
    return "its motor delivers no torque (a broken wire or motor, or a stripped gear)"


def causes_of_standstill(joint: Joint) -> str:
    """List the reasons why a joint that should move may stand still."""
    said = f"Something is blocking it, {without_torque(joint)}"
    if asked := opposed(joint):
        return f"{said}, its encoder is frozen, or {asked}"
    return f"{said}, or its encoder is frozen."


class Apart:
    """Compares the first servo of each joint with its other servos."""

    def __init__(self) -> None:
        self._first: dict[tuple[int, int], float] = {}

    def look(self, apart: Sequence[Sequence[float]]) -> tuple[int, int, float] | None:
        """Process a sample. If a servo no longer agrees with its joint's first servo, return the index of the joint,
        the index of that servo among the joint's other servos, and the change of the difference [rad].

        apart: for each joint, the angles of its other servos minus that of the first [rad]; NaN if either did not
        reply.
        """
        for joint, differences in enumerate(apart):
            for servo, difference in enumerate(differences):
                if isnan(difference):
                    continue
                changed = difference - self._first.setdefault((joint, servo), difference)
                if abs(changed) > ALLOWED_RAD:
                    return joint, servo, changed
        return None
