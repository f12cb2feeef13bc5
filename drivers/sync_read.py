"""Sync Read and Fast Sync Read: one request for the same contiguous registers of several servos, and their answers.

A servo's answer is a plain tuple: the ERR byte, then the registers' values in ticks; the ERR byte alone where the servo
refused; None where it did not answer. ERR holds a StatusError in its low bits and the Alert in bit 7.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Protocol

from fastcrc import crc16

from hil.drivers.control_table import ControlTable
from hil.drivers.packet import ALERT, BROADCAST_ID, HEADER, Framer, Instruction, Packet, encode

Answer = tuple[int, ...] | None

_crc = crc16.umts
_ERROR_BITS = 0xFF & ~ALERT
_FORMATS = {(1, False): "B", (2, False): "H", (4, False): "I", (1, True): "b", (2, True): "h", (4, True): "i"}


@dataclass(frozen=True)
class Span:
    """Registers that are read together: everything from the first to the last of them. `format` is struct's."""

    registers: tuple[str, ...]
    address: int
    size: int
    format: str

    @classmethod
    def of(cls, tables: Sequence[ControlTable], registers: Sequence[str]) -> "Span":
        """The span of these registers, in ascending order of address, which must be the same in all tables.

        Raises ValueError where two models have them at different places, KeyError where one has not got one.
        """
        spans = {cls._in(table, registers) for table in tables}
        if len(spans) != 1:
            models = ", ".join(sorted({table.model for table in tables}))
            raise ValueError(f"{models} do not have {', '.join(registers)} at the same addresses: no common Sync Read.")
        return spans.pop()

    @classmethod
    def each(cls, tables: Sequence[ControlTable], registers: Sequence[Sequence[str]]) -> "tuple[Span, ...]":
        """One span per table, `registers[i]` of `tables[i]`, all of the same stretch: from the first to the last.

        Raises KeyError where a table has not got one of its registers.
        """
        own = [cls._in(table, names) for table, names in zip(tables, registers, strict=True)]
        start = min(span.address for span in own)
        end = max(span.address + span.size for span in own)
        return tuple(
            cls(
                span.registers,
                start,
                end - start,
                "x" * (span.address - start) + span.format + "x" * (end - span.address - span.size),
            )
            for span in own
        )

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
    """A span for each servo. Raises ValueError where they are not of one stretch, with as many registers."""
    spans = (span,) * count if isinstance(span, Span) else tuple(span)
    if len(spans) != count or len({(each.address, each.size, len(each.registers)) for each in spans}) != 1:
        raise ValueError(f"{count} servos read together need spans of one stretch, as many registers in each: {spans}")
    return spans


class GroupRead(Protocol):
    """What the exchange needs of a group read. `request` and `reply_size` bytes go over the wire."""

    request: bytes
    reply_size: int

    def unpack(self, received: bytes) -> list[Answer] | None:
        """The usual case: every servo answered and nothing was stuffed. None when it is not that case."""
        ...

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        """The answers found among stuffed, damaged, foreign or missing answers; whether nothing more is to come."""
        ...


class SyncRead:
    """Each servo answers with a status packet of its own, in the order of `ids`.

    span: what is read, for all or one each, which then differ in what of the stretch is looked at (`Span.each`).
    """

    def __init__(self, ids: Sequence[int], span: Span | Sequence[Span]) -> None:
        self._ids = tuple(ids)
        spans = one_each(span, len(self._ids))
        self._values = {servo_id: Struct(f"<B{own.format}") for servo_id, own in zip(ids, spans, strict=True)}
        span = spans[0]
        self._size = span.size
        self.request = _request(Instruction.SYNC_READ, ids, span)
        # A damaged LEN must not swallow the answers behind it; stuffing adds at most a byte for every three.
        self._longest = span.size + 4 + (span.size + 2) // 3
        length = span.size + 11  # header, ID, LEN, INST, ERR, data, CRC
        self.reply_size = length * len(self._ids)
        behind_id = (span.size + 4).to_bytes(2, "little") + bytes((Instruction.STATUS,))
        # All answers in one unpacking: per servo the eight bytes up to INST as one number, ERR, the values, the CRC.
        self._unpack = Struct("<" + "".join(f"QB{own.format}H" for own in spans)).unpack
        width = len(span.registers) + 3
        self._parts = [
            (
                int.from_bytes(HEADER + bytes((servo_id,)) + behind_id, "little"),
                slice(n * length, (n + 1) * length - 2),
                n * width,
                slice(n * width + 1, (n + 1) * width - 1),
                (n + 1) * width - 1,
            )
            for n, servo_id in enumerate(self._ids)
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
        found: dict[int, Answer] = {}
        latest = -1
        for packet in Framer(longest=self._longest).feed(received):
            if packet.is_status and packet.id in self._ids and (answer := self._answer(packet)):
                turn = self._ids.index(packet.id)
                if turn <= latest:
                    found.clear()  # they answer in turn: what stands before is left over from an earlier request
                found[packet.id], latest = answer, turn
        # They answer in turn, so nobody speaks after the last one.
        return [found.get(servo_id) for servo_id in self._ids], self._ids[-1] in found

    def _answer(self, packet: Packet) -> Answer:
        if len(packet.data) == self._size:
            return self._values[packet.id].unpack(packet.body)
        # An answer of another length is one to an earlier request, or a refusal.
        return (packet.error,) if packet.error & _ERROR_BITS and not packet.data else None


class FastSyncRead:
    """All servos append to one status packet, which is never stuffed: `ERR ID data CRC` each.

    Each CRC is taken over everything from the packet's header on, so the last one vouches for the whole.
    """

    def __init__(self, ids: Sequence[int], span: Span | Sequence[Span]) -> None:
        self._ids = tuple(ids)
        spans = one_each(span, len(self._ids))
        self._values = {servo_id: Struct(f"<Bx{own.format}") for servo_id, own in zip(ids, spans, strict=True)}
        span = spans[0]
        # All parts in one unpacking: per servo its ERR, ID, values and CRC.
        self._whole = Struct("<8x" + "".join(f"BB{own.format}H" for own in spans))
        self._width = len(span.registers) + 3
        self.request = _request(Instruction.FAST_SYNC_READ, ids, span)
        part = span.size + 4  # ERR, ID, data, CRC
        length = 1 + part * len(self._ids)
        self._front = HEADER + bytes((BROADCAST_ID,)) + length.to_bytes(2, "little") + bytes((Instruction.STATUS,))
        self._parts = [
            (servo_id, len(self._front) + index * part, len(self._front) + (index + 1) * part)
            for index, servo_id in enumerate(self._ids)
        ]
        self.reply_size = self._parts[-1][2]

    def unpack(self, received: bytes) -> list[Answer] | None:
        if len(received) != self.reply_size or not received.startswith(self._front):
            return None
        fields = self._whole.unpack(received)
        if fields[-1] != _crc(received[:-2]):
            return None
        answers: list[Answer] = []
        at, width = 0, self._width
        for servo_id in self._ids:
            error = fields[at]
            if fields[at + 1] != servo_id or error & _ERROR_BITS:
                return None
            answers.append((error, *fields[at + 2 : at + width - 1]))
            at += width
        return answers

    def search(self, received: bytes) -> tuple[list[Answer], bool]:
        at = received.find(self._front)
        packet = received[at:] if at >= 0 else b""
        answers: list[Answer] = []
        for servo_id, start, end in self._parts:
            whole = len(packet) >= end and packet[start + 1] == servo_id
            if not whole or _crc(packet[: end - 2]) != int.from_bytes(packet[end - 2 : end], "little"):
                break
            answer = self._values[servo_id].unpack_from(packet, start)
            answers.append(answer[:1] if answer[0] & _ERROR_BITS else answer)
        # Behind a servo that is silent or damaged the packet cannot be trusted.
        answers += [None] * (len(self._ids) - len(answers))
        return answers, len(packet) >= self.reply_size


def _request(instruction: Instruction, ids: Sequence[int], span: Span) -> bytes:
    place = span.address.to_bytes(2, "little") + span.size.to_bytes(2, "little")
    return encode(BROADCAST_ID, instruction, place + bytes(ids))
