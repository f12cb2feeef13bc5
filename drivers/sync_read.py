"""Sync Read and Fast Sync Read: one request for the same contiguous registers of several servos, and their answers.

A servo's answer is a plain tuple: the ERR byte followed by the register values in ticks; only the ERR byte if the servo
refused; None if it did not reply. ERR holds a StatusError in its low bits and Alert in bit 7.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from struct import Struct
from typing import Protocol

from fastcrc import crc16

from hil.drivers.control_table import ControlTable
from hil.drivers.packet import ALERT, BROADCAST_ID, HEADER, Framer, Instruction, Packet, encode

Answer = tuple[int, ...] | None

_crc = crc16.umts
_ADDRESSES = 1 << 16
_ERROR_BITS = 0xFF & ~ALERT
_FAST_ID = 9
"""Index of the first servo's ID in a fast reply: after the header, broadcast ID, LEN, INST and the servo's ERR."""
_FORMATS = {(1, False): "B", (2, False): "H", (4, False): "I", (1, True): "b", (2, True): "h", (4, True): "i"}


@dataclass(frozen=True)
class Span:
    """Registers that are read together: all bytes from the first to the last. `format` is a `struct` format."""

    registers: tuple[str, ...]
    address: int
    size: int
    format: str

    @classmethod
    def of(cls, tables: Sequence[ControlTable], registers: Sequence[str]) -> "Span":
        """Return the span of these registers, given in ascending order of address.

        Raises ValueError if their addresses differ between the tables, KeyError if a table lacks one of them.
        """
        spans = {cls._in(table, registers) for table in tables}
        if len(spans) != 1:
            models = ", ".join(sorted({table.model for table in tables}))
            raise ValueError(
                f"{models} do not have {', '.join(registers)} at the same addresses: they need separate reads."
            )
        return spans.pop()

    @classmethod
    def each(cls, tables: Sequence[ControlTable], registers: Sequence[Sequence[str]]) -> "tuple[Span, ...]":
        """Return one span per table: span i decodes `registers[i]` of `tables[i]`, and all cover the same addresses.

        The common range ends at an address that every table defines, since servos refuse other reads. Raises KeyError
        if a table lacks one of its registers, and ValueError if there is no common range.
        """
        own = [cls._in(table, names) for table, names in zip(tables, registers, strict=True)]
        start = min(span.address for span in own)
        end = max(span.address + span.size for span in own)
        end = next((at for at in range(end, _ADDRESSES) if all(table.defines(at - 1) for table in tables)), 0)
        if not end:
            models = ", ".join(sorted({table.model for table in tables}))
            raise ValueError(f"{models} have no common address range that contains these registers.")
        return tuple(
            cls(
                span.registers,
                start,
                end - start,
                "x" * (span.address - start) + span.format + "x" * (end - span.address - span.size),
            )
            for span in own
        )

    def longer(self, by: int) -> "Span":
        """Return the span with `by` extra bytes before its registers."""
        return Span(self.registers, self.address - by, self.size + by, "x" * by + self.format)

    @classmethod
    def _in(cls, table: ControlTable, registers: Sequence[str]) -> "Span":
        entries = [table[name] for name in registers]
        start = end = entries[0].address
        code = ""
        for entry in entries:
            code += "x" * (entry.address - end) + _FORMATS[entry.size, entry.signed]
            end = entry.address + entry.size
        return cls(tuple(registers), start, end - start, code)


def one_each(span: Span | Sequence[Span], count: int) -> tuple[Span, ...]:
    """Return one span per servo; raises ValueError unless all cover the same addresses."""
    spans = (span,) * count if isinstance(span, Span) else tuple(span)
    if len(spans) != count or len({(each.address, each.size) for each in spans}) != 1:
        raise ValueError(
            f"reading {count} servos together needs one span per servo, all with the same addresses: {spans}"
        )
    return spans


class GroupRead(Protocol):
    """Interface of a group read. `request` is sent; the reply usually has `reply_size` bytes.

    expected: ID and number of data bytes of each status packet in the reply.
    """

    request: bytes
    reply_size: int
    expected: frozenset[tuple[int, int]]

    def unpack(self, received: bytes) -> list[Answer] | None:
        """Decode a regular reply, i.e. one in which every servo answered and no byte was stuffed; return None for any
        other reply.
        """
        ...

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        """Return the answers found in an irregular reply, and whether no further bytes are expected.

        Answers may be stuffed, damaged, missing, or meant for an earlier request.
        """
        ...

    def senders(self, received: bytes) -> list[int]:
        """Return the IDs of the intact answers found in an irregular reply, including IDs that were not addressed."""
        ...


class SyncRead:
    """A Sync Read: each servo answers with its own status packet, in the order of `ids`.

    span: the registers to read, one span for all servos or one per servo (`Span.each`). The spans of different
    servos cover the same addresses but decode different values.
    """

    def __init__(self, ids: Sequence[int], span: Span | Sequence[Span]) -> None:
        self._ids = tuple(ids)
        self.in_any_order = False
        """Whether answers are accepted in any order, which is necessary if only some of them are late."""
        spans = one_each(span, len(self._ids))
        self._values = {servo_id: Struct(f"<B{own.format}") for servo_id, own in zip(ids, spans, strict=True)}
        span = spans[0]
        self._size = span.size
        self.request = _request(Instruction.SYNC_READ, ids, span)
        # A damaged LEN must not swallow the answers that follow; stuffing adds at most one byte for every three.
        self._longest = span.size + 4 + (span.size + 2) // 3
        length = span.size + 11  # header, ID, LEN, INST, ERR, data, CRC
        self.reply_size = length * len(self._ids)
        self.expected = frozenset((servo_id, span.size) for servo_id in self._ids)
        behind_id = (span.size + 4).to_bytes(2, "little") + bytes((Instruction.STATUS,))
        # Unpack all answers at once: per servo the eight bytes up to INST as one number, ERR, the values, the CRC.
        self._unpack = Struct("<" + "".join(f"QB{own.format}H" for own in spans)).unpack
        widths = [len(own.registers) + 3 for own in spans]
        self._parts = [
            (
                int.from_bytes(HEADER + bytes((servo_id,)) + behind_id, "little"),
                slice(n * length, (n + 1) * length - 2),
                end - width,
                slice(end - width + 1, end - 1),
                end - 1,
            )
            for n, (servo_id, width, end) in enumerate(zip(ids, widths, accumulate(widths), strict=True))
        ]

    def unpack(self, received: bytes) -> list[Answer] | None:
        if len(received) != self.reply_size:
            return None
        fields = self._unpack(received)
        answers: list[Answer] = []
        for front, packet, first, answer, check in self._parts:
            if fields[first] != front or fields[check] != _crc(received[packet]):
                return None
            answers.append(fields[answer])
        return answers

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        if self.in_any_order:
            return self._search_any_order(received)
        found: dict[int, Answer] = {}
        latest, is_repeated = -1, False
        for packet in Framer(longest=self._longest).feed(received):
            if packet.is_status and packet.id in self._ids and (answer := self._answer(packet)):
                turn = self._ids.index(packet.id)
                if turn <= latest:
                    # Servos answer in order, so the answers so far belong to an earlier request,
                    # or a servo has answered with another servo's ID.
                    found.clear()
                    is_repeated = True
                found[packet.id], latest = answer, turn
        # Servos answer in order, so nothing follows the last one.
        is_over = self._ids[-1] in found
        if is_repeated and len(found) < len(self._ids):
            found.clear()  # it is unknown whose answers these are
        return [found.get(servo_id) for servo_id in self._ids], is_over

    def _search_any_order(self, received: bytes) -> tuple[list[Answer], bool]:
        found: dict[int, Answer] = {}
        for packet in Framer(longest=self._longest).feed(received):
            answer = self._answer(packet) if packet.is_status and packet.id in self._ids else None
            if answer and found.setdefault(packet.id, answer) != answer:
                return [None] * len(self._ids), False  # one of them belongs to another request or servo
        return [found.get(servo_id) for servo_id in self._ids], len(found) == len(self._ids)

    def senders(self, received: bytes) -> list[int]:
        packets = Framer(longest=self._longest).feed(received)
        return [packet.id for packet in packets if packet.is_status and len(packet.data) == self._size]

    def _answer(self, packet: Packet) -> Answer:
        if len(packet.data) == self._size:
            return self._values[packet.id].unpack(packet.body)
        # An answer of a different length belongs to an earlier request or is a refusal.
        return (packet.error,) if packet.error & _ERROR_BITS and not packet.data else None


class FastSyncRead:
    """A Fast Sync Read: each servo appends `ERR ID data CRC` to one status packet, which is never stuffed.

    Each CRC covers everything from the packet's header to that CRC, so the last one covers the whole packet.
    """

    def __init__(self, ids: Sequence[int], span: Span | Sequence[Span]) -> None:
        self._ids = tuple(ids)
        spans = one_each(span, len(self._ids))
        self._values = {servo_id: Struct(f"<Bx{own.format}") for servo_id, own in zip(ids, spans, strict=True)}
        span = spans[0]
        # Unpack all parts at once: per servo its ERR and values.
        self._whole = Struct("<8x" + "".join(f"Bx{own.format}2x" for own in spans))
        widths = [len(own.registers) + 1 for own in spans]
        self._answers = [slice(end - width, end) for width, end in zip(widths, accumulate(widths), strict=True)]
        self.request = _request(Instruction.FAST_SYNC_READ, ids, span)
        part = self._part = span.size + 4  # ERR, ID, data, CRC
        self._id_bytes = bytes(ids)
        length = 1 + part * len(self._ids)
        self._front = HEADER + bytes((BROADCAST_ID,)) + length.to_bytes(2, "little") + bytes((Instruction.STATUS,))
        self._parts = [
            (servo_id, len(self._front) + index * part, len(self._front) + (index + 1) * part)
            for index, servo_id in enumerate(self._ids)
        ]
        self.reply_size = self._parts[-1][2]
        self.expected = frozenset({(BROADCAST_ID, self.reply_size - len(self._front) - 3)})  # without ERR and CRC

    def unpack(self, received: bytes) -> list[Answer] | None:
        if len(received) != self.reply_size or not received.startswith(self._front):
            return None
        if (
            received[_FAST_ID :: self._part] != self._id_bytes
            or _crc(received[:-2]) != received[-2] | received[-1] << 8
        ):
            return None
        fields = self._whole.unpack(received)
        answers: list[Answer] = []
        for own in self._answers:
            answer = fields[own]
            if answer[0] & _ERROR_BITS:
                return None
            answers.append(answer)
        return answers

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        packet = self._packet(received)
        answers: list[Answer] = []
        for servo_id, start in self._intact(packet):
            if packet[start + 1] != servo_id:
                break
            answer = self._values[servo_id].unpack_from(packet, start)
            answers.append(answer[:1] if answer[0] & _ERROR_BITS else answer)
        # After a silent or damaged servo, the rest of the packet cannot be trusted.
        answers += [None] * (len(self._ids) - len(answers))
        return answers, len(packet) >= self.reply_size

    def senders(self, received: bytes) -> list[int]:
        packet = self._packet(received)
        return [packet[start + 1] for _, start in self._intact(packet)]

    def _packet(self, received: bytes) -> bytes:
        at = received.find(self._front)
        return received[at:] if at >= 0 else b""

    def _intact(self, packet: bytes) -> Iterator[tuple[int, int]]:
        """Yield the addressed ID and the start of each part that precedes the first missing or damaged one."""
        for servo_id, start, end in self._parts:
            if len(packet) < end or _crc(packet[: end - 2]) != int.from_bytes(packet[end - 2 : end], "little"):
                return
            yield servo_id, start


def _request(instruction: Instruction, ids: Sequence[int], span: Span) -> bytes:
    place = span.address.to_bytes(2, "little") + span.size.to_bytes(2, "little")
    return encode(BROADCAST_ID, instruction, place + bytes(ids))
