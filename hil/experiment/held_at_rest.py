"""Check, before the excitation begins, that a stabiliser moves the arm towards its rest pose and not away from it.

At that time, only the stabiliser drives the arm. If a joint moves farther from the rest pose than a spring and a damper
would let it swing, its motor is reversed or something else is moving it.
"""

from collections.abc import Sequence

from hil.config.schema import Config

__all__ = ["HeldAtRest"]

OVERSHOOT = 1.5
"""Largest allowed deviation from the rest pose, as a multiple of the largest deviation of any joint before torque was
switched on: in a two-joint arm, one joint makes the other swing.
"""

AWAY_RAD = 0.1
"""Additional allowance for the deviation [rad]: gravity deflects the spring, and a joint may break free suddenly."""


class HeldAtRest:
    """Watches the deviation from the rest pose. positions: angles before torque was switched on (joints,) [rad]."""

    def __init__(self, config: Config, positions: Sequence[float]) -> None:
        self._pose = config.arm.rest_pose
        first = [abs(at - pose) for at, pose in zip(positions, self._pose, strict=True)]
        self._allowed = OVERSHOOT * max(first) + AWAY_RAD

    def look(self, positions: Sequence[float]) -> tuple[int, str] | None:
        """Return the index of a joint that is too far from its rest pose, with a message; None if no joint is."""
        for index, (at, pose) in enumerate(zip(positions, self._pose, strict=True)):
            if abs(at - pose) > self._allowed:
                return index, (
                    f"moved before the start: it is {at - pose:+.3f} rad from its rest pose, but the stabiliser "
                    f"should hold it to within {self._allowed:.2f} rad. Check whether its motor is reversed "
                    "(direction) or delivers no torque (wires, gear), whether a hand or a cable pushes it, whether its "
                    "horn slips, and whether stabiliser.stiffness is high enough to overcome gravity."
                )
        return None
