"""The bytes that a serial receiver reads if data are sent at a different baud rate, or by several senders at once."""

from collections.abc import Iterable

_IDLE = 1
_STOP = 9  # index of the stop bit among the ten bits of a byte: start, eight data bits, stop


def heard(data: bytes, sent_baud: int, heard_baud: int) -> list[tuple[int, float]]:
    """Return the bytes that a receiver set to `heard_baud` reads while `data` is sent at `sent_baud` without pauses.

    Each byte is paired with the time at which it is complete [s after the first start bit]. The receiver samples the
    middle of each bit and passes on bytes with a wrong stop bit, as USB adapters do.
    """
    return [(byte, bits / sent_baud) for byte, bits in _received(_line(data), sent_baud / heard_baud)]


def overlaid(sent: Iterable[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return the bytes read from a line on which several devices send at one baud rate from given start times [bits].

    Data that overlap in time are merged; low bits prevail.
    """
    pieces: list[tuple[int, list[int]]] = []
    for start, data in sorted(sent):
        bits = _line(data)
        if pieces and start < pieces[-1][0] + len(pieces[-1][1]):
            first, line = pieces[-1]
            line += [_IDLE] * (start - first + len(bits) - len(line))
            for at, bit in enumerate(bits, start - first):
                line[at] &= bit
        else:
            pieces.append((start, bits))
    return [(start, bytes(byte for byte, _ in _received(line, 1.0))) for start, line in pieces]


def _line(data: bytes) -> list[int]:
    return [bit for byte in data for bit in (0, *(byte >> index & 1 for index in range(8)), 1)]


def _received(line: list[int], ratio: float) -> list[tuple[int, float]]:
    """Return the bytes read from a line, and the time [bits] at which each is complete. ratio: sender bits per receiver
    bit.
    """
    received: list[tuple[int, float]] = []
    at = 0.0
    while (start := _falling_edge(line, at)) is not None:
        if _level(line, start + 0.5 * ratio) == _IDLE:  # too short for a start bit
            at = start + 0.5 * ratio
            continue
        bits = [_level(line, start + (1.5 + index) * ratio) for index in range(8)]
        at = start + (_STOP + 0.5) * ratio
        received.append((sum(bit << index for index, bit in enumerate(bits)), start + 10 * ratio))
    return received


def _falling_edge(line: list[int], at: float) -> float | None:
    """Return the position of the next falling edge at or after `at`, or None; the line idles high."""
    before = _level(line, at)
    if before == 0 and at == int(at) and (at == 0 or line[int(at) - 1] == _IDLE):
        return at
    for index in range(int(at) + 1, len(line)):
        if line[index] == 0 and line[index - 1] == _IDLE:
            return float(index)
    return None


def _level(line: list[int], at: float) -> int:
    index = int(at)
    return line[index] if 0 <= index < len(line) else _IDLE
