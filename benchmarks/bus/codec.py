"""Protocol 2.0 as its manual describes it, independent of hil's own encoder; used by the host of `conversations`.

The code is simple rather than fast: the CRC is computed bit by bit. A status is decoded only if all its bytes are
correct.
"""

from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE

PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, REBOOT, CLEAR, BACKUP = 1, 2, 3, 4, 5, 6, 8, 0x10, 0x20
STATUS, SYNC_READ, SYNC_WRITE, FAST_SYNC_READ, BULK_READ, BULK_WRITE, FAST_BULK_READ = (
    *(0x55, 0x82, 0x83, 0x8A),
    *(0x92, 0x93, 0x9A),
)


class Status(NamedTuple):
    """One status packet, or one servo's part of a fast read."""

    id: int
    error: int
    data: bytes


class Wrong(Exception):
    """The received bytes are not a sequence of status packets."""


def crc16(data: bytes) -> int:
    """CRC-16 with the polynomial 0x8005, not reflected, initial value 0."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def stuffed(content: bytes) -> bytes:
    """Instruction and parameters with 0xFD added after every 0xFF 0xFF 0xFD."""
    return content.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def packet(servo_id: int, instruction: int, parameters: bytes = b"", *, damage: int = 0) -> bytes:
    """An instruction packet. damage: bits of the CRC to flip."""
    content = stuffed(bytes((instruction,)) + parameters)
    front = HEADER + bytes((servo_id,)) + (len(content) + 2).to_bytes(2, "little")
    return front + content + (crc16(front + content) ^ damage).to_bytes(2, "little")


def statuses(received: bytes) -> list[Status]:
    """Split `received` into status packets; raise Wrong if it contains anything else."""
    found = []
    while received:
        if not received.startswith(HEADER) or len(received) < 11:
            raise Wrong(f"no status packet at {received.hex(' ')}")
        end = 7 + int.from_bytes(received[5:7], "little")
        whole, received = received[:end], received[end:]
        if len(whole) < end or crc16(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
            raise Wrong(f"length or CRC of {whole.hex(' ')}")
        content = whole[7:-2]
        plain = content.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        if stuffed(plain) != content:
            raise Wrong(f"stuffing of {whole.hex(' ')}")
        if plain[0] != STATUS or len(plain) < 2:
            raise Wrong(f"no status: {whole.hex(' ')}")
        found.append(Status(whole[4], plain[1], plain[2:]))
    return found


def fast_parts(received: bytes, sizes: list[int], answering: int) -> list[Status]:
    """Split the answer to a fast read, which is not stuffed, into one part per servo.

    sizes: number of data bytes requested from each servo. answering: number of servos whose parts must have arrived.
    """
    if not answering:
        if received:
            raise Wrong(f"an answer that no servo can give: {received.hex(' ')}")
        return []
    length = 1 + sum(size + 4 for size in sizes)
    if received[:8] != HEADER + bytes((BROADCAST,)) + length.to_bytes(2, "little") + bytes((STATUS,)):
        raise Wrong(f"front of {received.hex(' ')}")
    parts: list[Status] = []
    at = 8
    for size in sizes[:answering]:
        end = at + size + 4
        if len(received) < end or crc16(received[: end - 2]) != int.from_bytes(received[end - 2 : end], "little"):
            raise Wrong(f"length or CRC of part {len(parts)} of {received.hex(' ')}")
        parts.append(Status(received[at + 1], received[at], received[at + 2 : end - 2]))
        at = end
    if at != len(received):
        raise Wrong(f"bytes after the last part of {received.hex(' ')}")
    return parts
