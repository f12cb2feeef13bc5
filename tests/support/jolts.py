"""The check for jolts on velocities alone, without an arm."""

from collections.abc import Sequence

import numpy as np

from hil.experiment.model_watch import JOLT, JOLT_RAD_S, JOLT_S, _jolting, jolt_back_s


class Jolts:
    """The state of the check. count: number of joints. interval: time between two exchanges [s]."""

    def __init__(self, count: int, interval: float) -> None:
        self._least = JOLT_RAD_S * max(1.0, interval / JOLT_S)
        self._longest = jolt_back_s(interval)
        self._joints = np.zeros(count, JOLT)
        self._joints["begun"] = -np.inf
        self._former = np.zeros((max(1, round(JOLT_S / interval)), count))

    def look(self, velocity: Sequence[float], seconds: float, now: float) -> tuple[int, float] | None:
        """Process velocities [rad/s], `seconds` after the previous ones [s]; return the joint that jolted and its
        change of velocity [rad/s], or None.
        """
        joint = _jolting(self._joints, self._former, tuple(velocity), seconds, now, self._least, self._longest)
        return None if joint < 0 else (joint, float(self._joints["change"][joint]))

    def forget(self) -> None:
        """Start over: nothing is known about the motion since the previous sample."""
        self._joints["count"] = 0
