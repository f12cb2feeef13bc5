"""Which servos act on an instruction packet, which reply, and in which order.

For choices made where the manual is silent, see "Conformance" in docs/fake-bus.md. In a group read, each servo waits
for the complete status of the one listed before it (source: ROBOTIS in DynamixelSDK issue 364).
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from hil.drivers.packet import (
    ALERT,
    BROADCAST_ID,
    HEADER,
    MAX_LENGTH,
    Instruction,
    Packet,
    StatusError,
    crc,
    encode_status,
)
from hil.fakes.bus.sync_reads import GroupReads, Reply
from hil.fakes.bus.uart import overlaid
from hil.fakes.bus.wire import BITS_PER_BYTE
from hil.fakes.servo.backup import RESET_ALL
from hil.fakes.servo.servo import EmulatedServo

Part = tuple[int, int, int]
"""One servo's part of a group read: its ID, and the address and number of bytes to read."""


class Line(Protocol):
    """Interface of the bus to the servos, implemented by `hil.fakes.bus.bus.FakeBus`."""

    @property
    def baud(self) -> int: ...

    def send(self, replies: Sequence[Reply], now: float) -> None:
        """Put replies on the wire.

        Each reply starts after its own delay, which counts from the end of the previous reply or, for the first, from
        `now`.
        """
        ...

    def measure(self, servo: EmulatedServo, address: int, length: int) -> None:
        """Update the registers in this address range with the state of the servo's joint."""
        ...

    def joints(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Return position [rad], velocity [rad/s] and motor current [A] of the joints, one value per servo."""
        ...

    def is_moving(self, servo: EmulatedServo) -> bool: ...

    @property
    def servos_refuse(self) -> bool:
        """Whether an active fault makes servos refuse commands."""
        ...

    def fault_error(self, servo: EmulatedServo, now: float) -> int:
        """Return the ERR byte with which an active fault makes this servo answer.

        If its error number (without the Alert bit) is not 0, the servo does not execute the instruction.
        """
        ...

    def count_collision(self) -> None: ...


class Instructions:
    """Makes the servos on a line act on packets. `route` must be called whenever an ID has changed."""

    def __init__(self, servos: Sequence[EmulatedServo], line: Line) -> None:
        self._servos = tuple(servos)
        self._line = line
        self._by_id: dict[int, tuple[EmulatedServo, ...]] = {}
        self._shadows: dict[int, tuple[EmulatedServo, ...]] = {}
        self._writers: dict[int, tuple[EmulatedServo, ...]] = {}
        self._group_reads = GroupReads(self._servos, line)
        self._broadcast: dict[int, Callable[[bytes, float], None]] = {
            Instruction.PING: self._broadcast_ping,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.FAST_SYNC_READ: self._fast_sync_read,
            Instruction.BULK_READ: self._bulk_read,
            Instruction.BULK_WRITE: self._bulk_write,
            Instruction.FAST_BULK_READ: self._fast_bulk_read,
        }
        self.route()

    def route(self) -> None:
        """Update the mapping from IDs to the servos that listen to them."""
        self._by_id, self._shadows, self._writers = {}, {}, {}
        self._group_reads.forget()
        for servo in self._servos:
            self._by_id[servo.id] = (*self._by_id.get(servo.id, ()), servo)
            if servo.shadow_id is not None:
                self._shadows[servo.shadow_id] = (*self._shadows.get(servo.shadow_id, ()), servo)
        for listener in self._by_id.keys() | self._shadows.keys():
            self._writers[listener] = self._by_id.get(listener, ()) + self._shadows.get(listener, ())

    def receive(self, packet: Packet, now: float) -> None:
        """Let the servos act on a packet whose last byte arrives at `now` [s]."""
        if packet.damaged:
            self._address(packet.id, lambda _: (StatusError.CRC, b""), now)
            return
        baud = self._line.baud
        for servo in self._servos:
            if servo.baud == baud and servo.connected and now >= servo.ready_at:
                servo.heard_at = now  # feeds the servo's watchdog, and shows below that it has received this packet
        if packet.id != BROADCAST_ID:
            self._single(packet, now)
        elif (act := self._broadcast.get(packet.instruction)) is not None:
            act(packet.body, now)
        elif packet.instruction != Instruction.FACTORY_RESET or packet.body != bytes((RESET_ALL,)):
            for servo in self._listening(now):
                self._execute(servo, packet.instruction, packet.body, now)

    # One servo

    def _single(self, packet: Packet, now: float) -> None:
        instruction, body = packet.instruction, packet.body
        if instruction == Instruction.STATUS:
            return
        if packet.id in self._shadows:
            for servo in self._shadows[packet.id]:
                if servo.id != packet.id and servo.heard_at == now:
                    self._execute(servo, instruction, body, now, shadow=True)
        if instruction == Instruction.READ:
            if len(body) != 4:
                self._address(packet.id, lambda _: (StatusError.DATA_LENGTH, b""), now, least_level=1)
                return
            address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
            self._address(packet.id, lambda servo: self._read(servo, address, length, now), now, least_level=1)
            return
        least_level = 0 if instruction == Instruction.PING else 2
        self._address(packet.id, lambda servo: self._execute(servo, instruction, body, now), now, least_level)

    def _address(
        self, servo_id: int, act: Callable[[EmulatedServo], tuple[int, bytes]], now: float, least_level: int = 2
    ) -> None:
        """Let the servos with this ID act, and reply if their Status Return Level is at least `least_level`."""
        answers: list[Reply] = []
        for servo in self._by_id.get(servo_id, ()):
            if servo.hears(now, self._line.baud):
                wanted = servo.status_return_level >= least_level
                delay_s, sender = servo.return_delay_s, servo.id
                error, data = act(servo)
                if wanted:
                    # A reboot clears the servo's Alert bit; once it has booted, it detects what is still wrong.
                    error |= servo.alert if now >= servo.ready_at else 0
                    answers.append((sender, delay_s, encode_status(sender, error, data)))
        self._line.send(self._overlaid(answers), now)

    def _overlaid(self, answers: list[Reply]) -> list[Reply]:
        if len(answers) < 2:
            return answers
        baud, end, pieces = self._line.baud, 0, []
        for start, data in overlaid((round(delay_s * baud), data) for _, delay_s, data in answers):
            pieces.append((answers[0][0], (start - end) / baud, data))
            end = start + BITS_PER_BYTE * len(data)
        if len(pieces) < len(answers):
            self._line.count_collision()
        return pieces

    def _execute(
        self, servo: EmulatedServo, instruction: int, body: bytes, now: float, *, shadow: bool = False
    ) -> tuple[int, bytes]:
        fault = self._line.fault_error(servo, now) if self._line.servos_refuse else 0
        if fault & ~ALERT:
            return fault, b""
        error, data = servo.execute(instruction, body, now, self._line.is_moving(servo), shadow=shadow)
        return error | fault, data

    def _read(self, servo: EmulatedServo, address: int, length: int, now: float) -> tuple[int, bytes]:
        fault = self._line.fault_error(servo, now) if self._line.servos_refuse else 0
        if fault & ~ALERT:
            return fault, b""
        self._line.measure(servo, address, length)
        error, data = servo.read(address, length)
        return error | fault, data

    def _write(self, servo: EmulatedServo, addressed: int, address: int, data: bytes, now: float) -> None:
        if self._line.servos_refuse and self._line.fault_error(servo, now) & ~ALERT:
            return
        (servo.write if servo.id == addressed else servo.write_as_shadow)(address, data)

    # All servos, or several

    def _broadcast_ping(self, _body: bytes, now: float) -> None:
        replies: list[Reply] = []
        for _, servos in sorted(self._by_id.items()):
            answers = []
            for servo in servos:
                if servo.heard_at == now:
                    error, data = servo.execute(Instruction.PING, b"", now, False)
                    status = encode_status(servo.id, error | servo.alert, data)
                    answers.append((servo.id, servo.return_delay_s, status))
            replies += self._overlaid(answers)
        self._line.send(replies, now)

    def _sync_write(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        writers = self._writers
        refuse = self._line.servos_refuse
        for at in range(4, len(body) - length, length + 1):
            servo_id = body[at]
            for servo in writers.get(servo_id, ()):
                if servo.heard_at != now:
                    continue
                if servo.id == servo_id and not refuse:
                    servo.write(address, body[at + 1 : at + 1 + length])
                else:
                    self._write(servo, servo_id, address, body[at + 1 : at + 1 + length], now)

    def _bulk_write(self, body: bytes, now: float) -> None:
        at = 0
        while at + 5 <= len(body):
            address, length = body[at + 1] | body[at + 2] << 8, body[at + 3] | body[at + 4] << 8
            data = body[at + 5 : at + 5 + length]
            if len(data) == length:
                for servo in self._writers.get(body[at], ()):
                    if servo.heard_at == now:
                        self._write(servo, body[at], address, data, now)
            at += 5 + length

    def _sync_read(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            return
        if not self._line.servos_refuse and (replies := self._group_reads.sync_read(body, self._by_id, now)):
            self._line.send(replies, now)
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        self._group_read([(servo_id, address, length) for servo_id in body[4:]], now)

    def _fast_sync_read(self, body: bytes, now: float) -> None:
        if len(body) < 5:
            return
        if not self._line.servos_refuse and (replies := self._group_reads.fast_sync_read(body, self._by_id, now)):
            self._line.send(replies, now)
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        self._fast_read([(servo_id, address, length) for servo_id in body[4:]], now)

    def _bulk_read(self, body: bytes, now: float) -> None:
        self._group_read(list(_bulk_parts(body)), now)

    def _fast_bulk_read(self, body: bytes, now: float) -> None:
        self._fast_read(list(_bulk_parts(body)), now)

    def _group_read(self, parts: Sequence[Part], now: float) -> None:
        replies: list[Reply] = []
        for servo_id, address, length in parts:
            answers = []
            for servo in self._answering(servo_id, now):
                error, data = self._read(servo, address, length, now)
                answers.append((servo_id, servo.return_delay_s, encode_status(servo_id, error | servo.alert, data)))
            if not self._append(answers, replies):
                break
        self._line.send(replies, now)

    def _fast_read(self, parts: Sequence[Part], now: float) -> None:
        """Send one packet from all servos; each servo appends its part and a CRC over everything sent so far."""
        size = 1 + sum(length + 4 for _, _, length in parts)
        if not parts or size > MAX_LENGTH:
            return
        whole = HEADER + bytes((BROADCAST_ID, size & 0xFF, size >> 8, Instruction.STATUS))
        replies: list[Reply] = []
        sent = 0
        for servo_id, address, length in parts:
            answers = []
            for servo in self._answering(servo_id, now):
                if servo.has_fast_reads:
                    error, data = self._read(servo, address, length, now)
                    part = whole + bytes((error | servo.alert, servo_id)) + data.ljust(length, b"\0")
                    part += crc(part).to_bytes(2, "little")
                    answers.append((servo_id, servo.return_delay_s, part[sent:]))
            if not self._append(answers, replies):
                break
            whole = part
            sent = len(whole)
        self._line.send(replies, now)

    def _append(self, answers: list[Reply], replies: list[Reply]) -> bool:
        """Append the replies of an ID's servos to `replies`; return whether the next servo hears one intact reply."""
        pieces = self._overlaid(answers)
        replies += pieces
        return len(pieces) == 1 and pieces[0][2] == answers[0][2]

    def _answering(self, servo_id: int, now: float) -> list[EmulatedServo]:
        servos = self._by_id.get(servo_id, ())
        return [servo for servo in servos if servo.heard_at == now and servo.status_return_level]

    def _listening(self, now: float) -> list[EmulatedServo]:
        return [servo for servo in self._servos if servo.hears(now, self._line.baud)]


def _bulk_parts(body: bytes) -> Iterator[Part]:
    for at in range(0, len(body) - 4, 5):
        yield body[at], body[at + 1] | body[at + 2] << 8, body[at + 3] | body[at + 4] << 8
