"""A half-duplex serial bus with fake servos on it and a plant behind them, in the bus's own time.

Bytes take wire time (ten bits each). A packet acts when its last byte arrives: the plant is advanced to that moment
with the motor currents in force before, then the addressed servos act. Replies go onto the wire after the servo's
return delay and reach the host `adapter_latency_us` later. Everything is worked out when the host writes, up to the
last packet of that write, even where that lies ahead of the clock; between two packets only a Bus Watchdog can act, and
the plant's advance is split at the moment it does.

Where the manual is silent:

- The registers of a Sync Read are sampled when its instruction's last byte arrives, in all servos alike.
- In a Sync Read or Fast Sync Read each servo waits for the one listed before it. Behind one that does not answer all
  stay silent, and a Fast Sync Read then breaks off in the middle (source: ROBOTIS in DynamixelSDK issue 364).
- To a broadcast Ping the servos answer one directly after the other by rising ID.
- When two speak at once, host and servo or two servos, both are lost: the later packet, and the former's bytes from
  there on.
- Two servos with one ID that answer at once are heard as nothing; both act on what they are told.
- The status of a write to ID or Baud Rate still comes from the old ID at the old baud.

Instructions of the next stage (Factory Reset, Clear, Control Table Backup, the Bulk group) get Instruction errors.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from drivers.clock import Clock
from drivers.packet import (
    BROADCAST_ID,
    HEADER,
    MAX_LENGTH,
    Framer,
    Instruction,
    Packet,
    StatusError,
    crc,
    encode_status,
)
from fakes.plant import Plant
from fakes.servo import PRESENT_END, PRESENT_START, Servo

GAP_S = 1.5e-3
"""A pause between two bytes of a packet after which a servo forgets its beginning [s]."""

BITS_PER_BYTE = 10

ROUNDING_S = 1e-9
"""Less than this two bytes on the wire do not overlap, they follow each other [s]."""

_ID_ADDRESS = 7


class _Arriving(NamedTuple):
    """Bytes on their way to the host: when the first is there, and how far apart they come [s]."""

    data: bytes
    first: float
    byte_s: float

    @property
    def last(self) -> float:
        return self.first + (len(self.data) - 1) * self.byte_s

    def count_by(self, deadline: float) -> int:
        """How many of the bytes are there by `deadline`."""
        if self.last <= deadline:
            return len(self.data)
        if self.first > deadline:
            return 0
        return min(int((deadline - self.first) / self.byte_s) + 1, len(self.data))

    def after(self, count: int) -> "_Arriving":
        """What is left when the first `count` bytes are gone."""
        return _Arriving(self.data[count:], self.first + count * self.byte_s, self.byte_s)


class FakeBus:
    """The wire, the adapter and everything behind it. Servo `i` of the sequence moves joint `i` of the plant.

    The plant's time is 0 when the bus is made. Times in this class are seconds on `clock`.
    """

    def __init__(
        self,
        servos: Sequence[Servo],
        plant: Plant,
        clock: Clock,
        *,
        baud: int = 1_000_000,
        adapter_latency_us: float = 0.0,
    ) -> None:
        if len(servos) != plant.joints:
            raise ValueError(f"{len(servos)} servos for a plant of {plant.joints} joints: one servo per joint")
        self.plant = plant
        self.clock = clock
        self.collisions = 0
        """How often host and servos spoke at once."""
        self._servos = tuple(servos)
        self._latency_s = adapter_latency_us * 1e-6
        self._framer = Framer(damaged=True)
        self._arriving: deque[_Arriving] = deque()
        self._origin = self._now = clock.now()
        self._sent_by = self._now
        self._reply_by = -math.inf  # when the last servo will have spoken
        for joint, servo in enumerate(self._servos):
            servo.power_up(self._now, plant.position[joint])
        self._broadcast: dict[int, Callable[[bytes, float], None]] = {
            Instruction.PING: self._broadcast_ping,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.FAST_SYNC_READ: self._fast_sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
        }
        self._joint = {servo: joint for joint, servo in enumerate(self._servos)}
        self.baud = baud
        self._route()

    @property
    def baud(self) -> int:
        """The host's baud. Servos set to another one hear nothing and are not heard."""
        return self._baud

    @baud.setter
    def baud(self, baud: int) -> None:
        self._baud = baud
        self._byte_s = BITS_PER_BYTE / baud

    @property
    def servos(self) -> dict[int, Servo]:
        """The servos by their present ID, in the state they have at the clock's present time."""
        self.advance(self.clock.now())
        return {servo.id: servo for servo in self._servos}

    # The host's side

    def write(self, data: bytes) -> None:
        """Put bytes on the wire, behind those still being sent."""
        start = max(self.clock.now(), self._sent_by)
        if self._framer.pending and start - self._sent_by > GAP_S:
            self._framer.reset()
        byte_s = self._byte_s
        end = self._sent_by = start + len(data) * byte_s
        for packet in self._framer.feed(data):
            arrived = end - self._framer.pending * byte_s
            if start >= self._reply_by or not self._collide(start, arrived):
                self._receive(packet, arrived)
            start = arrived

    def read(self, size: int, timeout_s: float) -> bytes:
        """Up to `size` bytes, waiting on the clock until they are there, at most `timeout_s` (0: take what is there).

        Nothing but the host's own writing brings new bytes, so a wait without end (`math.inf`) is over when all bytes
        on their way have come.
        """
        now = self.clock.now()
        deadline = now + timeout_s
        if timeout_s > 0:
            # Time moves on even when the timeout is too short to change the sum: a client that waits in a loop for the
            # end of its timeout gets there.
            deadline = max(deadline, math.nextafter(now, math.inf))
        taken = b""
        arriving = self._arriving
        while size and arriving:
            segment = arriving[0]
            count = min(size, segment.count_by(deadline))
            if not count:
                break
            taken += segment.data[:count]
            size -= count
            now = segment.first + (count - 1) * segment.byte_s
            if count == len(segment.data):
                arriving.popleft()
            else:
                arriving[0] = segment.after(count)
        self.clock.wait_until(deadline if size and deadline < math.inf else now)
        return taken

    @property
    def in_waiting(self) -> int:
        """Bytes that have reached the host and were not read."""
        now = self.clock.now()
        return sum(segment.count_by(now) for segment in self._arriving)

    @property
    def on_the_way(self) -> int:
        """Bytes that have reached the host or will do so without further writing."""
        return sum(len(segment.data) for segment in self._arriving)

    @property
    def sent_by(self) -> float:
        """When the last byte that the host wrote has left it."""
        return self._sent_by

    def discard_input(self) -> None:
        """Drop the bytes that have reached the host. Those still on their way come later, as they do on a real port."""
        self.read(self.in_waiting, 0.0)

    # Time

    def advance(self, until: float) -> None:
        """Move plant and watchdogs on to `until`; nothing when that is past."""
        if until <= self._now:
            return
        for servo in self._servos:
            if servo.watchdog_s and until > servo.heard_at + servo.watchdog_s:
                self._trip_watchdogs(until)
                break
        self._move_plant(until)

    def _trip_watchdogs(self, until: float) -> None:
        """Stop at the moment of each watchdog's trip before `until`, so that the plant sees the current drop there."""
        counting = [servo for servo in self._servos if servo.watchdog_s]
        for servo in sorted(counting, key=lambda servo: servo.heard_at + servo.watchdog_s):
            trip = servo.heard_at + servo.watchdog_s
            if trip < until:
                self._move_plant(max(trip, self._now))
                servo.trip_watchdog()

    def _move_plant(self, until: float) -> None:
        self.plant.advance(until - self._origin, [servo.motor_current_a for servo in self._servos])
        self._now = until

    # The servos' side

    def _receive(self, packet: Packet, now: float) -> None:
        self.advance(now)
        if packet.damaged:
            self._address(packet.id, lambda _: (StatusError.CRC, b""), now)
            return
        for servo in self._servos:
            if servo.hears(now, self._baud):
                servo.heard_at = now  # feeds its watchdog, and says below that it heard this packet
        if packet.id != BROADCAST_ID:
            self._single(packet, now)
        elif packet.instruction in self._broadcast:
            self._broadcast[packet.instruction](packet.body, now)
        else:
            for servo in self._listening(now):
                self._execute(servo, packet.instruction, packet.body, now)

    def _single(self, packet: Packet, now: float) -> None:
        """An instruction to one ID."""
        instruction, body = packet.instruction, packet.body
        if instruction == Instruction.STATUS:
            return
        if instruction == Instruction.READ:
            if len(body) != 4:
                self._address(packet.id, lambda _: (StatusError.DATA_LENGTH, b""), now, least_level=1)
                return
            address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
            self._address(packet.id, lambda servo: self._read(servo, address, length), now, least_level=1)
            return
        least_level = 0 if instruction == Instruction.PING else 2
        self._address(packet.id, lambda servo: self._execute(servo, instruction, body, now), now, least_level)

    def _address(
        self, servo_id: int, act: Callable[[Servo], tuple[int, bytes]], now: float, least_level: int = 2
    ) -> None:
        """Let the servo of this ID act, and answer if its Status Return Level is at least `least_level`."""
        answers = []
        for servo in self._by_id.get(servo_id, ()):
            if servo.hears(now, self._baud):
                wanted = servo.status_return_level >= least_level
                delay_s, sender = servo.return_delay_s, servo.id
                error, data = act(servo)
                if wanted:
                    answers.append((sender, error | servo.alert, data, delay_s))
        if len(answers) == 1:
            sender, error, data, delay_s = answers[0]
            self._send(encode_status(sender, error, data), now + delay_s)
        elif answers:
            self.collisions += 1

    def _execute(self, servo: Servo, instruction: int, body: bytes, now: float) -> tuple[int, bytes]:
        outcome = servo.execute(instruction, body, now, self.plant.position[self._joint[servo]])
        self._route()
        return outcome

    def _read(self, servo: Servo, address: int, length: int) -> tuple[int, bytes]:
        if address < PRESENT_END and address + length > PRESENT_START:
            joint, plant = self._joint[servo], self.plant
            servo.measure(self._now, plant.position[joint], plant.velocity[joint], plant.current[joint])
        return servo.read(address, length)

    def _broadcast_ping(self, _body: bytes, now: float) -> None:
        at = now
        for servo in sorted(self._listening(now), key=lambda servo: servo.id):
            error, data = servo.execute(Instruction.PING, b"", now, 0.0)
            at = self._send(encode_status(servo.id, error | servo.alert, data), at + servo.return_delay_s)

    def _sync_write(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        for at in range(4, len(body) - length, length + 1):
            for servo in self._by_id.get(body[at], ()):
                if servo.heard_at == now:
                    servo.write(address, body[at + 1 : at + 1 + length])
        if address <= _ID_ADDRESS:
            self._route()

    def _sync_read(self, body: bytes, now: float) -> None:
        if len(body) < 4:
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        at = now
        for servo_id in body[4:]:
            servo = self._answering(servo_id, now)
            if servo is None:
                return
            error, data = self._read(servo, address, length)
            at = self._send(encode_status(servo_id, error | servo.alert, data), at + servo.return_delay_s)

    def _fast_sync_read(self, body: bytes, now: float) -> None:
        """One packet from all servos; each appends its part and the CRC over everything up to there."""
        if len(body) < 5:
            return
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        ids = body[4:]
        size = 1 + len(ids) * (length + 4)
        if size > MAX_LENGTH:
            return
        whole = HEADER + bytes((BROADCAST_ID,)) + size.to_bytes(2, "little") + bytes((Instruction.STATUS,))
        at = now
        sent = 0
        for servo_id in ids:
            servo = self._answering(servo_id, now)
            if servo is None or servo.firmware < servo.model.fast_read_firmware:
                return
            error, data = self._read(servo, address, length)
            whole += bytes((error | servo.alert, servo_id)) + data.ljust(length, b"\0")
            whole += crc(whole).to_bytes(2, "little")
            at = self._send(whole[sent:], at + servo.return_delay_s)
            sent = len(whole)

    def _answering(self, servo_id: int, now: float) -> Servo | None:
        """The servo that answers a group read under this ID; None when there is none or more than one."""
        servos = self._by_id.get(servo_id, ())
        if len(servos) != 1 or servos[0].heard_at != now or servos[0].status_return_level == 0:
            return None
        return servos[0]

    def _listening(self, now: float) -> list[Servo]:
        return [servo for servo in self._servos if servo.hears(now, self._baud)]

    def _route(self) -> None:
        routes: dict[int, tuple[Servo, ...]] = {}
        for servo in self._servos:
            routes[servo.id] = (*routes.get(servo.id, ()), servo)
        self._by_id = routes

    # The wire

    def _send(self, data: bytes, start: float) -> float:
        """Put a servo's bytes on the wire from time `start`; the time at which the last one is over."""
        byte_s = self._byte_s
        end = start + len(data) * byte_s
        waiting = start < self._reply_by
        if waiting and self._collide(start, end):
            return end
        self._arriving.append(_Arriving(data, start + byte_s + self._latency_s, byte_s))
        if waiting:  # behind an earlier instruction's reply that is still to come
            self._arriving = deque(sorted(self._arriving, key=lambda segment: segment.first))
        self._reply_by = max(self._reply_by, end)
        return end

    def _collide(self, start: float, end: float) -> bool:
        """Whether a servo speaks while someone else does, from `start` to `end`.

        Then its bytes from `start` on are lost; who began at `start` is lost by not being heard.
        """
        kept: deque[_Arriving] = deque()
        collided = False
        for segment in self._arriving:
            begins = segment.first - segment.byte_s - self._latency_s
            ends = segment.last - self._latency_s
            if begins < end - ROUNDING_S and ends > start + ROUNDING_S:
                collided = True
                count = segment.count_by(start + self._latency_s)
                if count:
                    kept.append(segment._replace(data=segment.data[:count]))
            else:
                kept.append(segment)
        self._arriving = kept
        self.collisions += collided
        return collided
