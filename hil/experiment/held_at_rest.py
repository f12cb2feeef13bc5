"""Check, before the excitation begins, that a stabiliser moves the arm towards its rest pose and not away from it.

Nothing but the stabiliser drives the arm then. A joint that leaves the rest pose farther than a spring and a damper let
it swing has a reversed motor, or something else moves it.
"""

from collections.abc import Sequence

from hil.config.schema import Config

__all__ = ["HeldAtRest"]

OVERSHOOT = 1.5
"""Largest deviation from the rest pose, as a multiple of the largest deviation of any joint before torque came on: in
an arm of two joints, one swings the other.
"""

AWAY_RAD = 0.1
"""Additional allowance for the deviation [rad]: gravity deflects the spring, and a joint may break free suddenly."""


class HeldAtRest:
    """Watches the deviation from the rest pose. positions: angles before torque came on (joints,) [rad]."""

    def __init__(self, config: Config, positions: Sequence[float]) -> None:
        self._pose = config.arm.rest_pose
        first = [abs(at - pose) for at, pose in zip(positions, self._pose, strict=True)]
        self._allowed = OVERSHOOT * max(first) + AWAY_RAD

    def look(self, positions: Sequence[float]) -> tuple[int, str] | None:
        """Return a joint that has left the rest pose too far, with a sentence about it; None if there is none."""
        for index, (at, pose) in enumerate(zip(positions, self._pose, strict=True)):
            if abs(at - pose) > self._allowed:
                return index, (
                    f"moved before the start: it is {at - pose:+.3f} rad from its rest pose, where the stabiliser "
                    f"should hold it within {self._allowed:.2f} rad. Check whether its motor is reversed (direction) "
                    "or delivers no torque (wires, gear), whether a hand or a cable pushes it, whether its horn slips, "
                    "and whether stabiliser.stiffness outweighs gravity."
                )
        return None
