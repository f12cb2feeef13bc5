"""Read-backs of goals and operating modes: what a servo holds right before a cycle shows who commands it."""

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice
from random import Random
from typing import NamedTuple

from hil.drivers.sync_read import Answer, FastSyncRead, GroupRead, Span, SyncRead, one_each

__all__ = ["REMEMBERED", "TRY_AGAIN_S", "Overruled", "ReadBack"]

_READ_BACK_S = 0.015
"""Mean time between two read-backs [s]."""

_GOALS_PER_MODE = 2
"""Largest number of goal read-backs between two mode read-backs.

This number and the times are random, because regular checks might never detect a program that overwrites every other
goal.
"""

_GOALS_PER_MODE_IN_DOUBT = 4
"""The same while a foreign value is suspected, and every cycle is followed by a read-back."""

_RECENT = 4
"""Number of recent goals that a servo may still hold if writes are lost; the status detects longer losses."""

REMEMBERED = 128
"""Number of recent goals that a servo may still hold if writes are lost and the status has not yet detected that."""

_UNSURE_SIGHTINGS, _SIGHTINGS, _SIGHTED_S = 3, 2, 1.0
"""Numbers of read-backs of a foreign value that prove another writer, and the time in which they must occur [s].

Three are required for a goal that this program may have written in an earlier cycle, and for 0, which a servo itself
may have set: by then, the status has detected lost writes, a tripped watchdog or a reboot.
"""

TRY_AGAIN_S = 0.005
"""Delay after which a read-back for which a cycle left no time is tried again [s]."""

_FADES = 0.98
_IN_DOUBT_S = 0.3
"""Time after a foreign value was read, during which every cycle is followed by a read-back [s]."""


class Overruled(NamedTuple):
    """A servo (by its place among the IDs) that holds a goal or an operating mode that this program did not write."""

    place: int
    register: str
    value: int
    written: int


class ReadBack:
    """Reads back alternately the goals and the operating modes that the servos hold right before a cycle."""

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
        """Duration of the longest recent read-back [s]; decays from one read-back to the next."""
        self._goals = [own.registers[-1] for own in one_each(goal, len(ids))]
        self._modes = tuple(modes)
        self._is_of_modes = True
        self._until_mode = 0
        self._draw = Random(1)
        self._goals_sighted: list[deque[float]] = [deque() for _ in ids]
        self._modes_sighted: list[deque[float]] = [deque() for _ in ids]
        self.doubts_until = -math.inf
        self.sighted: Overruled | None = None
        """The latest value read back that this program did not write; it is recent until `doubts_until`."""

    @property
    def read(self) -> GroupRead:
        """The group read to send next: that of the goals or that of the operating modes."""
        return self.reads[self._is_of_modes]

    def took(self, seconds: float) -> None:
        self.longest = max(_FADES * self.longest, seconds)

    def look(self, servos: Sequence[Answer], sent: Sequence[Sequence[int]], now: float) -> Overruled | None:
        """Compare the answers with what was written; return what only another master can have written."""
        of_modes = self._is_of_modes
        is_nearly_sure = False
        for place, value in self._foreign(servos, sent):
            times = (self._modes_sighted if of_modes else self._goals_sighted)[place]
            while times and now - times[0] > _SIGHTED_S:
                times.popleft()
            times.append(now)
            if of_modes:
                self.sighted = Overruled(place, "Operating Mode", value, self._modes[place])
            else:
                self.sighted = Overruled(place, self._goals[place], value, sent[-1][place])
            is_ours = not of_modes and (value == 0 or any(value in each for each in sent))
            most = _UNSURE_SIGHTINGS if is_ours else _SIGHTINGS
            if len(times) >= most:
                return self.sighted
            self.doubts_until = now + _IN_DOUBT_S
            is_nearly_sure |= len(times) == most - 1
        is_in_doubt = now < self.doubts_until
        # A change of mode resets the goal, so a foreign goal may be its first sign.
        if not is_nearly_sure:
            most = _GOALS_PER_MODE_IN_DOUBT if is_in_doubt else 1 + int(_GOALS_PER_MODE * self._draw.random())
            self._until_mode = most if of_modes else self._until_mode - 1
            self._is_of_modes = self._until_mode == 0
        self.due = now if is_in_doubt else now + _READ_BACK_S * (0.5 + self._draw.random())
        return None

    def _foreign(self, servos: Sequence[Answer], sent: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
        """Place and value of each servo that holds a value that this program did not write."""
        if self._is_of_modes:
            return [
                (place, answer[-1])
                for place, (answer, mode) in enumerate(zip(servos, self._modes, strict=True))
                if answer is not None and answer[-1] != mode and len(answer) > 1
            ]
        # A servo that received its neighbour's goal is not commanded by another master.
        own = set().union(*islice(reversed(sent), _RECENT))
        return [
            (place, answer[-1])
            for place, answer in enumerate(servos)
            if answer is not None and answer[-1] not in own and len(answer) > 1
        ]
