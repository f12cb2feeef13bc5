"""Work of the motors: a motor that only takes energy out of the arm turns against its command.

It is checked only without a stabiliser: such an arm starts at a stable rest pose and cannot return more work than was
put in, so a motor that continually takes work out of it turns the wrong way.
"""

from collections.abc import Sequence

from hil.config.schema import Config

TOLERANCE_RAD = 0.04
"""Tolerance before a joint's sign is called wrong [rad]: work returned, divided by the joint's largest planned torque.

A healthy motor returns some because of delays: a heavy arm at 20 Hz up to 0.02 rad.
"""

_OF_OTHERS = 0.5
"""Share of the work put in by the other joints' motors that may come out at this joint."""


class Work:
    """Sums the work of each joint's motor. planned: largest planned goal of each joint [A, or V under PWM]."""

    def __init__(self, config: Config, planned: Sequence[float]) -> None:
        self._scales = [joint.torque_per_goal for joint in config.joints]
        self._least = [-TOLERANCE_RAD * goal * scale for goal, scale in zip(planned, self._scales, strict=True)]
        self._done = [0.0] * len(config.joints)
        self._held = [0.0] * len(config.joints)

    def look(self, joint: int, goal: float, moved: float | None) -> float | None:
        """Add the work done by the previous goal; return the work taken out of the arm [J] if it is too much.

        goal: the new goal [A or V]. moved: displacement since the previous sample [rad], None if it is unknown what the
        servo did meanwhile.
        """
        held, self._held[joint] = self._held[joint], goal
        if moved is not None:
            self._done[joint] += self._scales[joint] * held * moved
        done = self._done[joint]
        if done >= self._least[joint]:
            return None
        others = sum(work for other, work in enumerate(self._done) if other != joint and work > 0.0)
        return -done if done < self._least[joint] - _OF_OTHERS * others else None
