"""Limits on the size and rate of change of commanded goals, and rejection of values that are not finite."""

from collections.abc import Sequence
from math import inf

from hil.config.schema import Config
from hil.errors import Cause, SafetyStop


class CommandLimits:
    """Clamps goals from any source."""

    def __init__(self, config: Config) -> None:
        self._names = [joint.joint.title for joint in config.joints]
        self._limits = [joint.goal_limit for joint in config.joints]
        self._slew = config.safety.slew / config.experiment.rate
        self._former = [0.0] * len(config.joints)

    def clamp(self, goals: Sequence[float]) -> list[float]:
        """Clamp goals to each joint's limit and slew rate [A or V]. Raises SafetyStop for a goal that is not finite."""
        former, limits, slew = self._former, self._limits, self._slew
        if len(goals) != len(limits):
            raise ValueError(f"{len(goals)} goals for {len(limits)} joints")
        clamped = []
        # No comprehension and no keyword argument (strict): with cold caches, they would take longer than all the rest.
        for index, goal in enumerate(goals):
            limit = limits[index]
            if -limit <= goal <= limit and -slew <= goal - former[index] <= slew:
                clamped.append(goal)
            else:
                clamped.append(self._limited(goal, former[index], limit, self._names[index]))
        self._former = clamped
        return clamped

    def holding(self, goals: Sequence[float]) -> None:
        """Store the goals now in effect [A or V]; `clamp` limits the next change relative to these."""
        self._former = list(goals)

    def _limited(self, goal: float, former: float, limit: float, name: str) -> float:
        if not abs(goal) < inf:
            raise SafetyStop(
                f"{name} would have received a goal current of {goal}, which is not a finite number.",
                Cause.NOT_A_NUMBER,
            )
        wanted = limit if goal > limit else -limit if goal < -limit else goal
        change, slew = wanted - former, self._slew
        return former + slew if change > slew else former - slew if change < -slew else wanted
