"""Dynamixel Protocol 2.0 packets: CRC, byte stuffing, encoding, and finding packets in a byte stream.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". A packet on the wire is

    FF FF FD 00  ID  LEN_L LEN_H  INST  [ERR]  PARAM...  CRC_L CRC_H

LEN counts the bytes from INST to the CRC. First the bytes from INST to the last parameter are stuffed, then LEN is set,
then the CRC is computed over everything before it.
"""

from collections.abc import Callable, Iterator
from enum import IntEnum, IntFlag
from struct import Struct
from typing import NamedTuple

from fastcrc import crc16

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
MAX_ID = 252
MAX_LENGTH = 1024
"""Largest accepted LEN; a header with a larger one is treated as noise."""

_FRONT = Struct("<4sBH")  # header, ID, LEN
_STUFFED = b"\xff\xff\xfd"
NO_ID = (0xFD, 0xFF)
"""IDs that no servo can have, because they could be part of a header."""


class Instruction(IntEnum):
    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class StatusError(IntEnum):
    """Error numbers in the low seven bits of a status packet's ERR byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80
"""ERR bit 7: the servo's Hardware Error Status is not zero."""


class HardwareError(IntFlag):
    """Bits of Hardware Error Status and of the Shutdown mask."""

    INPUT_VOLTAGE = 1 << 0
    OVERHEATING = 1 << 2
    ENCODER = 1 << 3
    ELECTRICAL_SHOCK = 1 << 4
    OVERLOAD = 1 << 5


class Packet(NamedTuple):
    """One packet without its stuffing. `body` is everything between INST and CRC; in a status packet, it begins with
    ERR.
    """

    id: int
    instruction: int
    body: bytes
    damaged: bool = False
    """True if the CRC does not match. A `Framer` only returns such packets if created with `damaged=True`."""

    @property
    def is_status(self) -> bool:
        return self.instruction == Instruction.STATUS

    @property
    def error(self) -> int:
        """The ERR byte of a status packet."""
        return self.body[0]

    @property
    def data(self) -> bytes:
        """The parameters of a status packet."""
        return self.body[1:]


crc: Callable[[bytes], int] = crc16.umts
"""The CRC-16 used by the servos: polynomial 0x8005, initial value 0, not reflected."""


def stuff(payload: bytes) -> bytes:
    """Return the payload with an FD inserted after every FF FF FD, so that no header can appear inside a packet."""
    return payload.replace(_STUFFED, _STUFFED + b"\xfd")


def unstuff(payload: bytes) -> bytes:
    """Return the payload without the bytes inserted by `stuff`."""
    return payload.replace(_STUFFED + b"\xfd", _STUFFED)


def encode(packet_id: int, instruction: int, body: bytes = b"") -> bytes:
    """Return the bytes of one packet on the wire."""
    return _seal(packet_id, bytes((instruction,)) + body)


def encode_status(packet_id: int, error: int, data: bytes = b"") -> bytes:
    """Return the bytes of one status packet on the wire."""
    return _seal(packet_id, bytes((Instruction.STATUS, error)) + data)


def _seal(packet_id: int, payload: bytes) -> bytes:
    payload = stuff(payload)
    unsigned = _FRONT.pack(HEADER, packet_id, len(payload) + 2) + payload
    return unsigned + crc(unsigned).to_bytes(2, "little")


class Framer:
    """Finds packets in a stream of bytes and resynchronises after noise.

    A packet whose CRC does not match is counted in `bad_crc`. The search for a header then resumes at the next
    byte, since the length itself may be corrupted. With `damaged=True` the framer behaves like a servo: it trusts the
    length and returns the packet marked as damaged, because a servo answers such a packet with an error.
    A LEN above `longest` is treated as noise.
    """

    def __init__(self, *, damaged: bool = False, longest: int = MAX_LENGTH) -> None:
        self._buffer = bytearray()
        self._give_damaged = damaged
        self._longest = longest
        self.bad_crc = 0
        self.noise_bytes = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes as they arrive; yield each complete packet."""
        self._buffer += data
        while self._buffer and (packet := self._next()) is not None:
            yield packet

    @property
    def pending(self) -> int:
        """Number of received bytes not yet returned in a packet or dropped as noise."""
        return len(self._buffer)

    def reset(self) -> None:
        """Drop an incomplete packet, as a servo does after a gap of 1.5 ms between bytes."""
        self.noise_bytes += len(self._buffer)
        self._buffer.clear()

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                # Keep the last bytes, which may be the beginning of a header.
                self._drop(max(0, len(buffer) - len(HEADER) + 1))
                return None
            if start:
                self._drop(start)
            if len(buffer) < 7:
                return None
            length = buffer[5] | buffer[6] << 8
            if length < 3 or length > self._longest or buffer[4] in NO_ID:
                self._drop(1)
                continue
            end = 7 + length
            if len(buffer) < end:
                return None
            raw = bytes(buffer[: end - 2])
            if crc(raw) != buffer[end - 2] | buffer[end - 1] << 8:
                self.bad_crc += 1
                if self._give_damaged:
                    self._drop(end)
                    return Packet(raw[4], raw[7], raw[8:], damaged=True)
                self._drop(1)
                continue
            del buffer[:end]
            payload = unstuff(raw[7:])
            return Packet(raw[4], payload[0], payload[1:])

    def _drop(self, count: int) -> None:
        self.noise_bytes += count
        del self._buffer[:count]
