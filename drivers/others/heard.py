"""Unexpected bytes received in addition to the requested replies or instead of them, and advice for the user."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

from hil.drivers.packet import BROADCAST_ID, HEADER, Framer, Instruction, Packet
from hil.drivers.sync_read import Answer, GroupRead

__all__ = ["MOST_MIXED_UP", "MOST_STRANGERS", "Heard"]

MOST_STRANGERS = 2
"""Number of foreign packets that are tolerated during an experiment, since a late reply can look like one."""

MOST_MIXED_UP = 2
"""Number of tolerated replies whose IDs do not match the request; no answer in such a reply is used."""

_RECENT_S = 0.1
_INSTRUCTIONS = frozenset(Instruction) - {Instruction.STATUS}
_FRONT_SIZE = 8  # header, ID, LEN, INST
_BEFORE_LENGTH = 7  # header, ID, LEN
_BESIDE_DATA = 4  # INST, ERR, CRC
_LONGEST_CUT_OFF = 64
"""Largest LEN at which a truncated instruction is recognised as such; a damaged LEN is usually larger."""

_LEAST_REPEATED = 4
"""Minimum length at which a repeated part of a reply is recognised as such [bytes]."""

_PART_OF_A_REPLY = 8  # bytes that may accompany intact answers in a cut-off reply: a fast reply's header


class Heard:
    """Recognises other masters' packets, and late, repeated, damaged or foreign replies, for a fixed list of servos.

    ids: the servos' IDs. reads: the group reads that are sent.
    """

    def __init__(self, ids: Sequence[int], reads: Iterable[GroupRead]) -> None:
        self._ids = tuple(ids)
        self._expected: frozenset[tuple[int, int]] = frozenset()
        self.expect(reads)
        self.damaged_at = self.late_at = self.repeated_at = -math.inf
        """Times of the latest incomplete or damaged replies, of the latest late or repeated reply, and of the latest
        reply that was certainly a repetition [s on the port's clock].
        """
        self.latest = b""
        """Bytes received in reply to the latest request."""
        self.senders: list[int] = []
        """IDs of the intact replies among those that arrived at `damaged_at`."""
        self.mixed_up = 0
        """Number of replies since the last late one that contain one answer per servo, but other IDs than requested."""
        self.strangers: float = 0
        """Number of received packets that another master sent or requested."""

    def expect(self, reads: Iterable[GroupRead]) -> None:
        """From now on, treat replies to these reads as replies to this program."""
        self._expected = self._expected.union(*(read.expected for read in reads))

    def pending(self, received: bytes, now: float, *, echoes: bool) -> None:
        """Examine bytes that were pending before a request: another master's packets, or a late or repeated reply.

        now: time on the port's clock [s]. echoes: whether the adapter echoes what this program sends.
        """
        if len(received) >= _LEAST_REPEATED and received in self.latest:
            self.repeated_at = now
            self._was_late(now)
            return
        packets = _packets_within(received)
        self._count_strangers(packets, echoes=echoes)
        if any(packet.is_status for packet in packets):
            self._was_late(now)

    def _was_late(self, now: float) -> None:
        """Record a late or repeated reply. It may also be the reason for mixed-up IDs in the replies before it."""
        self.late_at, self.mixed_up = now, 0

    def instead(self, read: GroupRead, received: bytes, answers: Sequence[Answer], now: float, *, echoes: bool) -> None:
        """Examine bytes received instead of the regular reply to `read`; `answers` are the answers found in them."""
        self.beside(received, echoes=echoes)
        if any(front in self._expected - read.expected for front in _fronts_of_replies(received)):
            self._was_late(now)  # the beginning of a reply to an earlier request
        complete = sum(answer is not None for answer in answers) / len(answers)
        if complete < 1.0 and len(received) > complete * read.reply_size + _PART_OF_A_REPLY:
            self.damaged_at, self.senders = now, read.senders(received)
            is_whole = len(received) == read.reply_size and len(self.senders) == len(self._ids)
            self.mixed_up += is_whole and set(self.senders) <= set(self._ids) and tuple(self.senders) != self._ids

    def beside(self, received: bytes, *, echoes: bool) -> None:
        """Count the packets of other masters among bytes received instead of a regular reply."""
        self._count_strangers(_packets_within(received), echoes=echoes)
        if not echoes:
            self.strangers += sum(self._is_anothers(*front) for front in _fronts_of_instructions(received))

    def continued(self, before: bytes, received: bytes, now: float) -> None:
        """Examine bytes that may be the rest of a reply that was incomplete when its timeout expired.

        before: the bytes received before the timeout.
        """
        whole = [packet for packet in _packets_within(before + received) if packet.is_status]
        if len(whole) > len(_packets_within(before)) + len(_packets_within(received)):
            self._was_late(now)

    def advice(self, now: float, url: str) -> str:
        """Return advice on irregular replies and other bytes received in the last 0.1 s; "" if there were none."""
        since = now - _RECENT_S
        if self.repeated_at > since:
            return "Replies are repeated in transit and collide with what is sent: check the adapter and the cables."
        if self.late_at > since:
            return (
                "Replies did arrive, but too late or twice: check the adapter's latency timer and whether other "
                "programs keep this computer busy."
            )
        if self.damaged_at <= since:
            return ""
        if strange := [each for each in self.senders if each not in self._ids]:
            return (
                f"Intact replies came from ID {', '.join(map(str, dict.fromkeys(strange)))}, which was not addressed: "
                f"a servo's ID has changed, or the reply is another servo's. `hil scan {url}` lists the IDs."
            )
        if self.mixed_up or len(set(self.senders)) < len(self.senders):
            return self.mixed_up_advice(url)
        return "Bytes arrived, but damaged or incomplete: check the cables, and whether anything else sends on the bus."

    def mixed_up_advice(self, url: str) -> str:
        """Return advice for the user about replies whose IDs do not match the request."""
        return (
            f"Intact replies came from IDs {', '.join(map(str, self.senders))}, although each servo was "
            "asked once: replies are repeated or mixed up, or two servos have the same ID. "
            f"`hil scan {url}` lists the IDs."
        )

    def _count_strangers(self, packets: Sequence[Packet], *, echoes: bool) -> None:
        if not echoes:
            self.strangers += sum(self._is_strange(packet) for packet in packets)

    def _is_strange(self, packet: Packet) -> bool:
        """Whether this packet is another master's instruction or a reply to one.

        A status packet without data does not count, since it may be an error reply to this program.
        """
        if not packet.is_status:
            return True
        return len(packet.data) > 0 and (packet.id, len(packet.data)) not in self._expected

    def _is_anothers(self, servo_id: int, length: int) -> bool:
        """Whether what looks like a truncated instruction comes from another master and is not a damaged reply."""
        lengths = {size + _BESIDE_DATA for _, size in self._expected}
        return servo_id in (*self._ids, BROADCAST_ID) and length <= _LONGEST_CUT_OFF and length not in lengths


def _packets_within(received: bytes) -> list[Packet]:
    """Return all complete packets, including those that follow or lie within a packet cut off by a collision."""
    found: list[Packet] = []
    at = received.find(HEADER)
    while at >= 0:
        end = at + _BEFORE_LENGTH + int.from_bytes(received[at + 5 : at + 7], "little")
        packets = list(Framer().feed(received[at:end])) if end <= len(received) else []
        found += packets
        at = received.find(HEADER, end if packets else at + len(HEADER))
    return found


def _fronts_of_replies(received: bytes) -> Iterator[tuple[int, int]]:
    """Yield the ID and number of data bytes, without stuffing, of each status packet, complete or not."""
    for at in _headers(received):
        front = received[at : at + _FRONT_SIZE]
        if len(front) == _FRONT_SIZE and front[-1] == Instruction.STATUS:
            length = int.from_bytes(front[5:7], "little")
            stuffed = received.count(b"\xff\xff\xfd\xfd", at, at + _BEFORE_LENGTH + length)
            yield front[4], length - stuffed - _BESIDE_DATA


def _fronts_of_instructions(received: bytes) -> Iterator[tuple[int, int]]:
    """Yield the ID and LEN of each instruction that is cut off by the next packet.

    A master does not receive while it transmits: it hears only the part of a foreign packet that precedes its own.
    """
    for at, following in pairwise(_headers(received)):
        if received[at + _FRONT_SIZE - 1] in _INSTRUCTIONS:  # no byte of a header is an instruction
            length = int.from_bytes(received[at + 5 : at + 7], "little")
            if following - at < _BEFORE_LENGTH + length:
                yield received[at + 4], length


def _headers(received: bytes) -> Iterator[int]:
    """Yield the index of each header in the received bytes."""
    return (found.start() for found in re.finditer(re.escape(HEADER), received))
