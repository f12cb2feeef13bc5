"""Bulk Read: one request in which each servo gives registers of its own choice, each with a status packet of its own.

What the control cycle has of it: all servos give their state, and one of them, in turn, also what says whether it is
still driven as it should be. A servo's answer is the same as in `hil.drivers.sync_read`.
"""

from collections.abc import Sequence
from struct import Struct

from hil.drivers.packet import ALERT, BROADCAST_ID, Framer, Instruction, Packet, encode
from hil.drivers.sync_read import Answer, Span

_ERROR_BITS = 0xFF & ~ALERT


class BulkRead:
    """`spans[i]` of the servo `ids[i]`, in that order."""

    def __init__(self, ids: Sequence[int], spans: Sequence[Span]) -> None:
        self._ids = tuple(ids)
        self._sizes = {servo_id: span.size for servo_id, span in zip(ids, spans, strict=True)}
        self._values = {servo_id: Struct(f"<B{span.format}") for servo_id, span in zip(ids, spans, strict=True)}
        parts = (
            bytes((servo_id,)) + span.address.to_bytes(2, "little") + span.size.to_bytes(2, "little")
            for servo_id, span in zip(ids, spans, strict=True)
        )
        self.request = encode(BROADCAST_ID, Instruction.BULK_READ, b"".join(parts))
        self.reply_size = sum(span.size + 11 for span in spans)  # header, ID, LEN, INST, ERR, data, CRC
        longest = max(span.size for span in spans)
        # A damaged LEN must not swallow the answers behind it; stuffing adds at most a byte for every three.
        self._longest = longest + 4 + (longest + 2) // 3

    def unpack(self, received: bytes) -> list[Answer] | None:
        """Once in many cycles, so the way that finds everything is fast enough."""
        if len(received) != self.reply_size:
            return None
        answers, _ = self.search(received)
        return None if None in answers else answers

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        found: dict[int, Answer] = {}
        for packet in Framer(longest=self._longest).feed(received):
            if packet.is_status and packet.id in self._sizes and (answer := self._answer(packet)):
                found[packet.id] = answer
        # They answer in turn, so nobody speaks after the last one.
        return [found.get(servo_id) for servo_id in self._ids], self._ids[-1] in found

    def _answer(self, packet: Packet) -> Answer:
        if len(packet.data) == self._sizes[packet.id]:
            return self._values[packet.id].unpack(packet.body)
        return (packet.error,) if packet.error & _ERROR_BITS and not packet.data else None
