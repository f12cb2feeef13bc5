"""The servos' ear: instruction packets out of the bytes on the wire."""

from collections.abc import Iterator

from drivers.packet import BROADCAST_ID, HEADER, MAX_ID, MAX_LENGTH, Framer, Packet, crc, unstuff

_STUFFED = b"\xff\xff\xfd\xfd"


class Receiver:
    """Finds packets as `drivers.packet.Framer(damaged=True)` does; whole good packets, the usual case, by a short way."""

    def __init__(self) -> None:
        self._framer = Framer(damaged=True)
        self._at = 0
        self._size = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes as they come; yield each whole packet."""
        self._size, self._at = len(data), 0
        if not self._framer.pending:
            while (packet := self._whole(data)) is not None:
                yield packet
        if self._at < self._size:
            rest, self._at = data[self._at :], self._size
            yield from self._framer.feed(rest)

    @property
    def pending(self) -> int:
        """How many of the bytes taken stand behind the last packet given."""
        return self._size - self._at + self._framer.pending

    @property
    def damaged(self) -> int:
        """How many packets with a wrong CRC were given so far."""
        return self._framer.bad_crc

    def reset(self) -> None:
        """Forget a packet that was begun, as a servo does after a gap of 1.5 ms between bytes."""
        self._framer.reset()

    def _whole(self, data: bytes) -> Packet | None:
        """The packet that begins right here, if it is all there and undamaged."""
        at = self._at
        if data[at : at + 4] != HEADER or self._size < at + 10:
            return None
        packet_id = data[at + 4]
        length = data[at + 5] | data[at + 6] << 8
        end = at + 7 + length
        if end > self._size or not 3 <= length <= MAX_LENGTH or (packet_id > MAX_ID and packet_id != BROADCAST_ID):
            return None
        raw = data[at : end - 2]
        if crc(raw) != data[end - 2] | data[end - 1] << 8:
            return None
        self._at = end
        body = raw[8:]
        instruction = raw[7]
        if _STUFFED in raw:
            payload = unstuff(raw[7:])
            instruction, body = payload[0], payload[1:]
        return Packet(packet_id, instruction, body)
