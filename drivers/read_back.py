"""Read-backs of goals and operating modes: what a servo holds right before a cycle shows who commands it."""

import math
from collections import deque
from collections.abc import Sequence
from random import Random
from typing import NamedTuple

from hil.drivers.sync_read import Answer, FastSyncRead, GroupRead, Span, SyncRead, one_each

__all__ = ["REMEMBERED", "TRY_AGAIN_S", "Overruled", "ReadBack"]

_READ_BACK_S = 0.015
"""Mean time between two read-backs [s]."""

_GOALS_PER_MODE = 2
"""Largest number of read-backs of goals between two of modes.

Number and times are drawn, because a regular pattern might never see a program that overwrites every other goal.
"""

_GOALS_PER_MODE_IN_DOUBT = 4
"""The same after a sighting, while every cycle is followed by a read-back."""

REMEMBERED = 4
"""Number of latest goals that a servo may still hold if writes are lost; more are a matter of the status."""

_GOAL_SIGHTINGS, _MODE_SIGHTINGS, _SIGHTED_S = 3, 2, 1.0
"""Read-backs of a foreign goal or mode that prove another writer, and the time within which they must be made [s].

With three, goals that are lost are noticed first, by the status.
"""

TRY_AGAIN_S = 0.005
"""Time after which a read-back for which there was no time is tried again [s]."""

_FADES = 0.98
_IN_DOUBT_S = 0.3
"""Time after a sighting during which every cycle is followed by a read-back [s]."""


class Overruled(NamedTuple):
    """A servo (by its place among the IDs) that holds a goal or an operating mode that this program did not write."""

    place: int
    register: str
    value: int
    written: int


class ReadBack:
    """Looks in turn at the goals and at the operating modes that the servos hold right before a cycle."""

    def __init__(
        self,
        ids: Sequence[int],
        goal: Span | Sequence[Span],
        mode: Span | Sequence[Span],
        modes: Sequence[int],
        *,
        fast: bool,
    ) -> None:
        kind = FastSyncRead if fast else SyncRead
        self.reads: tuple[GroupRead, GroupRead] = kind(ids, goal), kind(ids, mode)
        self.due = -math.inf
        self.longest = 0.0
        """Duration of the longest read-back, which fades from memory [s]."""
        self._goals = [own.registers[-1] for own in one_each(goal, len(ids))]
        self._modes = tuple(modes)
        self._is_of_modes = True
        self._until_mode = 0
        self._draw = Random(1)
        self._goals_sighted: list[deque[float]] = [deque() for _ in ids]
        self._modes_sighted: list[deque[float]] = [deque() for _ in ids]
        self.doubts_until = -math.inf

    @property
    def read(self) -> GroupRead:
        """The next group read."""
        return self.reads[self._is_of_modes]

    def took(self, seconds: float) -> None:
        self.longest = max(_FADES * self.longest, seconds)

    def look(self, servos: Sequence[Answer], sent: Sequence[Sequence[int]], now: float) -> Overruled | None:
        """Compare the answers with what was written; return what only another master can have written."""
        # A servo that was given its neighbour's goal is not one that another master commands.
        own = {tick for goals in sent for tick in goals}
        of_modes = self._is_of_modes
        is_nearly_sure = False
        for place, answer in enumerate(servos):
            if answer is None or len(answer) == 1:
                continue
            value = answer[-1]
            if value == self._modes[place] if of_modes else value in own:
                continue
            times = (self._modes_sighted if of_modes else self._goals_sighted)[place]
            while times and now - times[0] > _SIGHTED_S:
                times.popleft()
            times.append(now)
            most = _MODE_SIGHTINGS if of_modes else _GOAL_SIGHTINGS
            if len(times) >= most:
                if of_modes:
                    return Overruled(place, "Operating Mode", value, self._modes[place])
                return Overruled(place, self._goals[place], value, sent[-1][place])
            self.doubts_until = now + _IN_DOUBT_S
            is_nearly_sure |= len(times) == most - 1
        is_in_doubt = now < self.doubts_until
        # A change of mode resets the goal, so a foreign goal may be the first that is seen of it.
        if not is_nearly_sure:
            most = _GOALS_PER_MODE_IN_DOUBT if is_in_doubt else self._draw.randint(1, _GOALS_PER_MODE)
            self._until_mode = most if of_modes else self._until_mode - 1
            self._is_of_modes = self._until_mode == 0
        self.due = now if is_in_doubt else now + _READ_BACK_S * self._draw.uniform(0.5, 1.5)
        return None
