"""An exchange that also reads back, between its cycles, what the servos hold."""

import math
from collections.abc import Sequence

from hil.drivers.exchange import HOST_S, Exchange
from hil.drivers.others.read_back import (
    GOALS,
    OVERTIME_SHARE,
    TORQUE,
    TRY_AGAIN_S,
    Overruled,
    ReadBack,
    pause_after,
)
from hil.drivers.sync_read import Answer, GroupRead, Span

_LATE_SHARE = 0.25
"""Time by which the reply to any read-back may be late, as a fraction of `ReadBackExchange._overtime`."""


class ReadBackExchange(Exchange):
    """An `Exchange` that also reads back goals, settings or Torque Enable once `add_read_back` has been called."""

    _read_back: ReadBack | None = None
    _overtime: float
    """Longest time by which a read-back may delay the next cycle [s]; 0 if the status includes Torque Enable."""

    awaited_until = -math.inf
    """Reply deadline of the latest repeated read-back, which may delay the next cycle [s on the port's clock]."""

    read_back_at = math.inf
    """When to call `overruled` again, before the next cycle [s on the port's clock]."""

    def add_read_back(
        self,
        goal: Span | Sequence[Span],
        mode: Span | Sequence[Span],
        torque: Span | Sequence[Span],
        modes: Sequence[Sequence[int]],
        limits: Sequence[Sequence[int]],
    ) -> None:
        """Prepare the read-backs made by `overruled` (see `ReadBack`).

        goal: spans of Bus Watchdog, limits of the motor's output, and goal. mode: spans that end with the settings.
        torque: spans that begin with Torque Enable. modes, limits: each servo's settings and limits.
        """
        back = self._read_back = ReadBack(
            *(self.ids, goal, mode, modes, torque, limits),
            watches_torque=not self._shows_torque,
            interval=self._interval,
            fast=self.fast,
        )
        self._wire_s |= {read: self._port.wire_time(len(read.request) + read.reply_size) for read in back.every}
        self._overtime = 0.0 if self._shows_torque else OVERTIME_SHARE * self._interval
        self.heard.expect(back.every)
        self.read_back_at = -math.inf

    @property
    def is_in_doubt(self) -> bool:
        """Whether a read-back has recently found a value that this program did not write."""
        return self._read_back is not None and self._now() < self._read_back.doubts_until

    @property
    def sighted(self) -> Overruled | None:
        """A value that was recently read back but not written by this program; None if there is none."""
        return self._read_back.sighted if self._read_back is not None and self.is_in_doubt else None

    @property
    def modes_seen_ago(self) -> float:
        """Time since all servos were last confirmed to be in their modes [s]; infinite if they never were."""
        return math.inf if self._read_back is None else self._now() - self._read_back.modes_seen_at

    @property
    def watchdogs(self) -> Sequence[tuple[int, int]]:
        """Index and Bus Watchdog of each servo in the latest read-back of goals."""
        return () if self._read_back is None else self._read_back.watchdogs

    @property
    def torque_off(self) -> int | None:
        """Index of a servo whose Torque Enable was last read back as 0; None if there is none."""
        return None if self._read_back is None else self._read_back.torque_off

    def read_torque(self) -> int | None:
        """Read Torque Enable of all servos now, outside a cycle; then return `torque_off`. Raises PortLost."""
        back = self._read_back
        if back is not None and not self._late_possible:
            back.kind, now = TORQUE, self._now()
            back.look(self._ask_back(back.read, now, self._usual.reply_time.timeout), self._sent, now)
        return self.torque_off

    def read_back_every(self, off_wire: float) -> tuple[float, float]:
        """Return the expected time between two read-backs of a goal [s] (0 if most cycles leave time for a read-back),
        and the duration of the shortest cycle that leaves time for a read-back [s].

        off_wire: duration of an exchange beyond its wire time [s].
        """
        back = self._read_back
        if back is None or not self._interval:
            return 0.0, 0.0
        fixed = self._usual.wire_s + 2.0 * off_wire
        goals = self._wire_s[back.reads[GOALS]]
        shortest = fixed + min(goals, self._wire_s[back.shortest])
        if shortest <= self._interval:
            return 0.0, shortest
        delay = fixed + goals - self._interval
        return 2.0 * pause_after(delay) if delay <= self._overtime else math.inf, shortest

    @property
    def lost(self) -> Overruled | None:
        """A servo that, according to read-backs, has missed many of the latest goals; None if there is none."""
        return self._read_back.lost if self._read_back is not None else None

    def overruled(self, due: float) -> Overruled | None:
        """Read back goals, settings or Torque Enable if there is time before the next cycle, due at `due` [s].

        Missing replies are ignored here; the next cycle detects them.

        Returns a value that only another master can have written, or None. Raises PortLost.
        """
        back = self._read_back
        if back is None or not self._sent:
            return None
        if back.kind != GOALS:
            # Of all that is read back, the next cycle overwrites only the goals. They are read last if there is time.
            before_goals = due - self._takes(back.reads[GOALS], back) - HOST_S
            if self._now() + self._takes(back.read, back) <= before_goals:
                found = self._held(back, before_goals)
                if found is not None or back.kind != GOALS:
                    return found
        return self._held(back, due)

    def _takes(self, read: GroupRead, back: ReadBack) -> float:
        """Return the longest time that a read-back is expected to take [s]."""
        off_wire = self._took - self._latest_plan.wire_s
        return self._wire_s[read] + max(off_wire, back.longest)

    def _held(self, back: ReadBack, due: float) -> Overruled | None:
        """Read back once if this is possible before `due` [s], or slightly later if a read-back is overdue.

        If there is no time for all servos, only one is read.
        """
        port, now, read = self._port, self._now(), back.read
        takes = self._takes(read, back)
        alone = now + takes > due >= now + self._takes(back.alone, back)
        if alone:
            read, takes = back.alone, self._takes(back.alone, back)
        end = due + self._overtime if now + takes > due and now >= back.overdue_at else due
        if now + takes > end or self._late_possible:
            back.postponed(now)
            if back.kind != GOALS and not self._late_possible and now + self._takes(back.shortest, back) <= due:
                back.kind = GOALS  # they take less time to read; the other registers remain due
                return self._held(back, due)
            back.took(0.0)  # one long read-back, while this computer was busy, must not prevent all later ones
            left_less_time = self._latest_plan.read is not self._usual.read
            self.read_back_at = now if self._late_possible or left_less_time else now + TRY_AGAIN_S
            return None
        port.clock.wait_until(due - takes - HOST_S)
        before = self._now()
        if before + takes > end:  # woken up late
            self.read_back_at = before + TRY_AGAIN_S
            return None
        # Even if there is barely enough time, a slightly late reply is still accepted.
        servos = self._ask_back(read, before, max(end - before, takes + _LATE_SHARE * self._overtime))
        now = self._now()
        if now > due:
            self.awaited_until = now
        # If nothing at all arrived, the reply may be late and would be mistaken for the reply to a repeated read.
        if None in servos and self.heard.latest and back.may_repeat(now, takes):
            # A packet from another master may have destroyed the reply, and the next cycle overwrites its goals.
            self.awaited_until = now + takes + self._wire_s[read]
            servos = self._ask_back(read, now, self.awaited_until - now)
        self.read_back_at = now
        if None in servos:
            self._expect_late()
            if not self.is_in_doubt:
                self.read_back_at = now + TRY_AGAIN_S  # a late reply costs the next cycle time
        else:
            back.took(min(now - before, 2.0 * takes) - self._wire_s[read])
        if alone:
            servos = [servos[0] if at == back.place else None for at in range(len(self.ids))]
        found = back.look(servos, self._sent, now, collided=self._latest_plan.is_after_loss, alone=alone)
        back.delayed(now, max(0.0, now - due), alone=alone)
        if back.is_unexpected:
            self.read_status_next()  # the status distinguishes lost goals from another master's goals
        return found

    def _ask_back(self, read: GroupRead, start: float, timeout: float) -> list[Answer]:
        """Send the read at `start` [s]; return the answers that arrive within `timeout` [s]."""
        port = self._port
        expected = port.reply_time(timeout, len(read.request))
        if self._echoes:
            received = port.ask(read.request, len(read.request) + read.reply_size, expected, start)
            received = received.removeprefix(read.request)
        else:
            received = port.ask(read.request, read.reply_size, expected, start)
        if port.overheard:
            self._overhear()
        self.heard.latest = received
        servos = read.unpack(received)
        if servos is None:
            # A master that writes between two cycles is heard only here if the reply in the next cycle is complete.
            servos = read.search(received)[0]
            self.heard.beside(received, echoes=self._echoes)
        return servos
