"""The half-duplex wire from the servos to the host: when bytes arrive, and what a collision destroys."""

from collections import deque
from functools import partial
from typing import NamedTuple

from hil.fakes.bus.uart import heard

BITS_PER_BYTE = 10

ROUNDING_S = 1e-9
"""Longest overlap of two transmissions that still count as consecutive [s]."""


class Arriving(NamedTuple):
    """Bytes in transit to the host.

    first: arrival time of the first byte [s].
    byte_s: time between two bytes [s].
    """

    data: bytes
    first: float
    byte_s: float

    @property
    def last(self) -> float:
        return self.first + (len(self.data) - 1) * self.byte_s

    def count_by(self, deadline: float) -> int:
        """Return the number of bytes that have arrived by `deadline`."""
        if self.last <= deadline:
            return len(self.data)
        if self.first > deadline:
            return 0
        return min(int((deadline - self.first) / self.byte_s) + 1, len(self.data))

    def after(self, count: int) -> "Arriving":
        """Return the bytes that remain after the first `count`, with their arrival times."""
        return Arriving(self.data[count:], self.first + count * self.byte_s, self.byte_s)


_arriving = partial(tuple.__new__, Arriving)  # half the time of Arriving(...)


class Wire:
    """Replies in transit, ordered by arrival time at the host, which is `latency_s` after transmission."""

    def __init__(self, baud: int, latency_s: float) -> None:
        self._set_baud(baud)
        self.collisions = 0
        """Number of times that two devices transmitted at once."""
        self.reply_by = float("-inf")
        """Time at which the last servo will have finished transmitting [s]."""
        self._latency_s = latency_s
        self._held = float("-inf"), float("-inf")
        """Times at which the latest delayed transmission ends on the wire and at the host [s]."""
        self._arriving: deque[Arriving] = deque()

    def _set_baud(self, baud: int) -> None:
        self.baud = baud
        """The host's baud rate."""
        self.byte_s = BITS_PER_BYTE / baud

    def change_baud(self, baud: int, now: float) -> None:
        """Change the host's baud rate at `now` [s]; what is still in transit arrives as garbage."""
        sent_baud = self.baud
        self._set_baud(baud)
        kept: deque[Arriving] = deque()
        for segment in self._arriving:
            count = segment.count_by(now)
            if count:
                kept.append(segment._replace(data=segment.data[:count]))
            starts = segment.first + (count - 1) * segment.byte_s
            for byte, at in heard(segment.data[count:], sent_baud, baud):
                kept.append(Arriving(bytes((byte,)), starts + at, self.byte_s))
        self._arriving = deque(sorted(kept, key=lambda segment: segment.first))

    def put(self, data: bytes, start: float, late_s: float = 0.0) -> float:
        """Transmit a servo's data from time `start`; return the time at which the transmission ends.

        late_s: additional delay in the adapter [s], which also holds back what follows. If another reply is being
        transmitted, both are lost.
        """
        byte_s = self.byte_s
        end = start + len(data) * byte_s
        waiting = start < self.reply_by
        if waiting and self.collide(start, end):
            return end
        arriving = self._arriving
        first = start + byte_s + self._latency_s + late_s
        sent_before, free_at = self._held
        if start >= sent_before and (late_s or first < free_at):
            first = max(first, free_at)
            self._held = end, first + len(data) * byte_s
        arriving.append(_arriving((data, first, byte_s)))
        if len(arriving) > 1 and arriving[-2].first > first:  # ahead of an earlier reply
            self._arriving = deque(sorted(arriving, key=lambda segment: segment.first))
        if end > self.reply_by:
            self.reply_by = end
        return end

    def echo(self, data: bytes, start: float) -> None:
        """Echo the data that the host sends from time `start` on."""
        self._arriving.append(Arriving(data, start + self.byte_s + self._latency_s, self.byte_s))
        self._arriving = deque(sorted(self._arriving, key=lambda segment: segment.first))

    def occupy(self, until: float) -> None:
        """Mark the wire as busy with a transmission that does not reach the host."""
        self.reply_by = max(self.reply_by, until)

    def take(self, size: int, deadline: float, now: float) -> tuple[bytes, float]:
        """Return up to `size` bytes that have arrived by `deadline`, and the arrival time of the last one, or
        `now` if that is later [s].
        """
        arriving = self._arriving
        if arriving and len(arriving[0].data) == size:  # the usual case: the reply to one write, in one read
            segment = arriving[0]
            last = segment.first + (size - 1) * segment.byte_s
            if last <= deadline:
                del arriving[0]
                return segment.data, last if last > now else now
        taken = b""
        while size and arriving:
            segment = arriving[0]
            count = segment.count_by(deadline)
            if not count:
                break
            count = min(count, size)
            taken += segment.data[:count]
            size -= count
            now = max(now, segment.first + (count - 1) * segment.byte_s)
            if count == len(segment.data):
                arriving.popleft()
            else:
                arriving[0] = segment.after(count)
        return taken, now

    def count_by(self, now: float) -> int:
        """Return the number of bytes that have reached the host by `now` [s]."""
        return sum(segment.count_by(now) for segment in self._arriving) if self._arriving else 0

    @property
    def on_the_way(self) -> int:
        """Number of bytes that have reached the host or will reach it."""
        return sum(len(segment.data) for segment in self._arriving)

    @property
    def next_reply_by(self) -> float:
        """Arrival time of the end of the next contiguous group of replies [s]; infinite if there is none."""
        last = float("inf")
        for segment in self._arriving:
            if last < segment.first - 4 * segment.byte_s:
                break
            last = segment.last
        return last

    def cut(self, now: float) -> None:
        """Drop everything that has not arrived by `now`, because the cable is unplugged."""
        kept = [segment._replace(data=segment.data[: segment.count_by(now)]) for segment in self._arriving]
        self._arriving = deque(segment for segment in kept if segment.data)

    def collide(self, start: float, end: float) -> bool:
        """Return whether a transmission from `start` to `end` collides with a servo's transmission.

        If so, the servo's bytes from `start` on are lost. The other transmission is lost as well: the caller must not
        deliver it.
        """
        kept: deque[Arriving] = deque()
        collided = False
        for segment in self._arriving:
            begins = segment.first - segment.byte_s - self._latency_s
            ends = segment.last - self._latency_s
            if begins < end - ROUNDING_S and ends > start + ROUNDING_S:
                collided = True
                count = segment.count_by(start + self._latency_s)
                if count:
                    kept.append(segment._replace(data=segment.data[:count]))
            else:
                kept.append(segment)
        self._arriving = kept
        self.collisions += collided
        return collided
