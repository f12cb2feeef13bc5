"""Correction of steps in a position reading while an arm is being lowered: a joint cannot jump, but its reading can.

A reading that is far from the position predicted from the previous position and the velocities counts as false: from
then on, the difference is subtracted. A joint whose readings step again and again is no longer corrected.
"""

from typing import NamedTuple

from hil.drivers.state import State

__all__ = ["PositionSteps"]

STEP_RAD = 0.04
"""Smallest step that is corrected [rad]; the feedback control handles smaller ones."""

BENDS_RAD_S2 = 200.0
"""Largest joint acceleration assumed while an arm is being lowered [rad/s^2]; it sets the uncertainty of predictions.
"""

MOST_STEPS = 6
"""Largest number of corrected steps per joint; a single false reading causes two."""


class _Seen(NamedTuple):
    """A joint's latest corrected position [rad], its velocity [rad/s], and their time [s]."""

    position: float
    velocity: float
    time: float


class PositionSteps:
    """Corrects the positions read after `state`, an exchange that all servos answered."""

    def __init__(self, state: State) -> None:
        at = state.time_before_write
        self._seen = [_Seen(*each, at) for each in zip(state.position, state.velocity, strict=True)]
        self._offset = [0.0] * len(self._seen)
        self._steps = [0] * len(self._seen)

    def corrected(self, state: State) -> State:
        """Return the exchange with all steps removed from its positions."""
        position, at = list(state.position), state.time_before_write
        for joint, is_missing in enumerate(state.missing):
            if not is_missing:
                position[joint] = self._continued(joint, _Seen(position[joint], state.velocity[joint], at))
        return state._replace(position=tuple(position)) if any(self._offset) else state

    def _continued(self, joint: int, now: _Seen) -> float:
        seen = self._seen[joint]
        if self._steps[joint] < MOST_STEPS and _is_step(seen, now.position + self._offset[joint], now):
            self._steps[joint] += 1
            away = seen.position + 0.5 * (now.time - seen.time) * (seen.velocity + now.velocity) - now.position
            self._offset[joint] = away if _is_step(seen, now.position, now) else 0.0
        self._seen[joint] = now._replace(position=now.position + self._offset[joint])
        return self._seen[joint].position


def _is_step(seen: _Seen, position: float, now: _Seen) -> bool:
    """Whether a position can be explained neither by motion at the joint's velocities nor by standstill."""
    seconds = now.time - seen.time
    way = 0.5 * seconds * (seen.velocity + now.velocity)
    unsure = STEP_RAD + 0.5 * BENDS_RAD_S2 * seconds**2
    return not min(0.0, way) - unsure <= position - seen.position <= max(0.0, way) + unsure
