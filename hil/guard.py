"""Looks at every sample and stops the arm when a limit is passed."""

import math
from collections.abc import Sequence

from drivers.packet import ALERT
from drivers.state import State
from hil.config import Config
from hil.errors import SafetyStop


class Guard:
    """Compares each sample with the limits of the configuration. `look` raises SafetyStop."""

    def __init__(self, config: Config) -> None:
        self._names = [str(joint.joint) for joint in config.joints]
        self._low = [joint.position_limit[0] for joint in config.joints]
        self._high = [joint.position_limit[1] for joint in config.joints]
        self._velocity = [joint.velocity_limit for joint in config.joints]
        self._current = [joint.goal_limit for joint in config.joints]
        self._max_missing = config.safety.max_missing
        self._missing = [0] * len(config.joints)

    def clamp(self, goal_current: Sequence[float]) -> list[float]:
        """Goal currents within each joint's current limit [A]; NaN becomes a SafetyStop, never a command."""
        clamped = []
        for index, goal in enumerate(goal_current):
            if not math.isfinite(goal):
                raise SafetyStop(f"{self._names[index]}: the goal current is {goal}, which is no number.")
            limit = self._current[index]
            clamped.append(min(max(goal, -limit), limit))
        return clamped

    def look(self, state: State) -> None:
        """Raise SafetyStop when a joint passed a limit, reports a hardware error or stays silent."""
        for index, position in enumerate(state.position):
            if state.missing[index]:
                self._count_missing(index)
                continue
            self._missing[index] = 0
            if state.error[index] & ALERT:
                raise SafetyStop(
                    f"{self._names[index]} raised its alert bit: read Hardware Error Status, find the cause, reboot it."
                )
            if not self._low[index] <= position <= self._high[index]:
                raise SafetyStop(
                    f"{self._names[index]} is at {position:.3f} rad, outside its position limit "
                    f"[{self._low[index]:g}, {self._high[index]:g}]. Lower experiment.peak_torque."
                )
            velocity = state.velocity[index]
            if not abs(velocity) <= self._velocity[index]:
                raise SafetyStop(
                    f"{self._names[index]} moves at {velocity:.2f} rad/s, more than its velocity limit "
                    f"{self._velocity[index]:g}. Lower experiment.peak_torque."
                )

    def _count_missing(self, index: int) -> None:
        self._missing[index] += 1
        if self._missing[index] > self._max_missing:
            raise SafetyStop(
                f"{self._names[index]} missed {self._missing[index]} replies in a row; {self._max_missing} are allowed."
                " Check its cable and its supply."
            )
