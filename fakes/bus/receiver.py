"""Servo-side receiver: extracts instruction packets from the bytes on the wire."""

from functools import partial
from struct import Struct

from hil.drivers.packet import BROADCAST_ID, HEADER, MAX_ID, MAX_LENGTH, Framer, Instruction, Packet, crc, unstuff

MOST_ASKED = 1000
"""Maximum number of different group reads that are cached."""

_STUFFED = b"\xff\xff\xfd\xfd"
_FRONT = Struct("<4sBHB")  # header, ID, LEN, INST
_GROUP_READS = frozenset(
    {Instruction.SYNC_READ, Instruction.FAST_SYNC_READ, Instruction.BULK_READ, Instruction.FAST_BULK_READ}
)


_packet = partial(tuple.__new__, Packet)  # half the time of Packet(...)


class Receiver:
    """Finds packets as `hil.drivers.packet.Framer(damaged=True)` does, with a fast path for complete, valid ones."""

    def __init__(self) -> None:
        self._framer = Framer(damaged=True)
        self._length = 0
        self._asked: dict[bytes, Packet] = {}
        """Cache of parsed group reads, keyed by their bytes; a host sends the same reads repeatedly."""

    def feed(self, data: bytes) -> list[tuple[Packet, int]]:
        """Take bytes as they arrive; return each complete packet and the number of bytes that follow it."""
        framer = self._framer
        found: list[tuple[Packet, int]] = []
        at, size = 0, len(data)
        if not framer.pending:
            while at < size and (packet := self._whole(data, at, size)) is not None:
                at += self._length
                found.append((packet, size - at))
        if at < size:
            for packet in framer.feed(data[at:]):
                found.append((packet, framer.pending))
        return found

    @property
    def pending(self) -> int:
        """Number of received bytes not yet returned in a packet or dropped as noise."""
        return self._framer.pending

    @property
    def damaged(self) -> int:
        """Number of packets with a wrong CRC so far."""
        return self._framer.bad_crc

    def reset(self) -> None:
        """Drop an incomplete packet, as a servo does after a gap of 1.5 ms between bytes."""
        self._framer.reset()

    def _whole(self, data: bytes, at: int, size: int) -> Packet | None:
        """Return the packet that begins at `at` and set `_length`; None if it is incomplete or damaged."""
        if size < at + 10:
            return None
        header, packet_id, length, instruction = _FRONT.unpack_from(data, at)
        end = at + 7 + length
        if header != HEADER or end > size or not 3 <= length <= MAX_LENGTH:
            return None
        if packet_id > MAX_ID and packet_id != BROADCAST_ID:
            return None
        self._length = end - at
        raw = data[at:end]
        known = self._asked.get(raw)
        if known is not None:
            return known
        if crc(raw[:-2]) != raw[-2] | raw[-1] << 8:
            return None
        body = raw[8:-2]
        if _STUFFED in raw:
            payload = unstuff(raw[7:-2])
            instruction, body = payload[0], payload[1:]
        packet = _packet((packet_id, instruction, body, False))
        if instruction in _GROUP_READS and len(self._asked) < MOST_ASKED:
            self._asked[raw] = packet
        return packet
