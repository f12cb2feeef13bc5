"""Detect swapped replies: two servos, each of which has jumped to the other's former position.

If two servos have swapped IDs, or if their replies are mixed up in transit, both angles jump although no encoder is
wrong. The servos' raw positions [ticks] are compared, since each servo has its own zero and direction.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from hil.drivers.joint import Joint
from hil.drivers.state import State

__all__ = ["SwappedReplies", "swapped_advice"]

_NEAR = 0.25
"""How close each servo's new position must be to the other's former one, relative to the distance between the former
positions.
"""

_LEAST_TICKS = 6
"""Smallest distance between two positions [ticks] at which a swap can be distinguished from encoder noise."""


def swapped_advice(first: int, second: int) -> str:
    """Return the explanation for two servos, given by their IDs, that report each other's position."""
    return (
        f"The replies of IDs {first} and {second} seem to be swapped, since each of these servos now reports the "
        "other's former position: the servos have swapped IDs, or an adapter or another program is mixing up the "
        "replies. List the servos with `hil scan`, and check what is connected between the adapter and the servos."
    )


class _Seen(NamedTuple):
    """A servo and its raw position in two successive exchanges [ticks]."""

    drive: Joint
    before: float
    now: float


class SwappedReplies:
    """Finds two servos of the arm whose replies have been swapped."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        self._drives = [joint.drives for joint in joints]

    def look(self, joint: int, now: State, before: Sequence[State | None]) -> tuple[int, int] | None:
        """Return the IDs of two servos that have exchanged positions, beginning with the one of this joint; None if
        there are no such servos.

        now: the latest exchange. before: for each joint, the previous exchange that it answered, or None.
        """
        seen = [[] if state is None else [*self._seen(index, state, now)] for index, state in enumerate(before)]
        for own in seen[joint]:
            for other in (each for servos in seen for each in servos):
                if _have_exchanged(own, other):
                    return own.drive.id, other.drive.id
        return None

    def _seen(self, joint: int, before: State, now: State) -> Iterator[_Seen]:
        drives = self._drives[joint]
        for drive, former, latest in zip(drives, _angles(joint, before), _angles(joint, now), strict=True):
            yield _Seen(drive, _ticks(drive, former), _ticks(drive, latest))


def _angles(joint: int, state: State) -> list[float]:
    """Angle of each of the joint's servos [rad]."""
    first = state.position[joint]
    return [first, *(first + difference for difference in (state.apart[joint] if state.apart else ()))]


def _ticks(drive: Joint, angle: float) -> float:
    return angle / drive.position_unit + drive.zero_ticks


def _have_exchanged(own: _Seen, other: _Seen) -> bool:
    """Whether each of the two servos is now at the other's former position; False if any position is NaN."""

    def distance(first: float, second: float) -> float:
        # Within one turn, because a joint's zero may be shifted by whole turns when the bus is opened.
        return abs(math.remainder(first - second, own.drive.servo.position_steps))

    apart = distance(own.before, other.before)
    landed = distance(own.now, other.before), distance(other.now, own.before)
    return apart >= _LEAST_TICKS and all(each <= _NEAR * apart for each in landed)
