"""The man in the middle: a serial port between program and fake bus that modifies bytes as the attacks demand.

Outside attacks, bytes pass unchanged, at no cost. During an attack every reply is parsed, modified, and passed
on when it is due. In either case, everything the host reads and writes is stored with its time.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

from benchmarks.fault_campaign.attack import (
    AT_ONCE,
    FORGED,
    ON_INSTRUCTIONS,
    ON_MOTORS,
    ON_PROGRAM,
    ON_REPLIES,
    ON_TIME,
    Attack,
    Kind,
    Request,
    packets_of,
    request_in,
    without_goal,
)
from benchmarks.fault_campaign.forger import Forger
from benchmarks.fault_campaign.touch import Killed, happen, overwrite_goals, prepare
from hil.drivers.packet import HEADER, encode_status
from hil.fakes.protocol_fake import FakeSerial

HICCUP_EVERY_S, RIVAL_EVERY_S = 0.2, 0.013
"""Time between two stalls of a program with hiccups, and between two goals of a second master [s]."""

LOOK_BACK_S = 0.5
"""Time before a replay attack from which replies are stored for it [s]."""


@dataclass
class Traffic:
    """Bytes that passed through the port, in order: (time [s], whether they were read, bytes) for every write and read.

    A read and the write of the next request may take place at the same moment of the virtual clock.
    """

    passed: list[tuple[float, bool, bytes]] = field(default_factory=list)


class Middle(FakeSerial):
    """A port of a fake arm with a man in the middle."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.traffic = Traffic()
        self.over = False
        """The program has ended, so no further attacks are made."""
        self.dead = False
        """The program was killed, although its clean-up still runs in this process."""
        self._attacks: Sequence[Attack] = ()
        self._random = Random(0)
        self._wakes = math.inf
        self._sleeps = -math.inf
        self._to_come: list[Attack] = []
        self._queue: deque[tuple[float, bytes]] = deque()
        self._raw = bytearray()
        self._request: Request | None = None
        self._forger = Forger()
        self._fights: list[Attack] = []
        self._again: dict[Attack, float] = {}
        self._former: dict[tuple[int, int], bytes] = {}
        self._held: bytes | None = None
        self._undo: list[Callable[[], None]] = []
        super().__init__(*args, **kwargs)

    def attack(self, attacks: Sequence[Attack], seed: int) -> None:
        """Schedule these attacks; their random choices depend on `seed`."""
        self._attacks = attacks
        self._random = Random(seed)
        self._to_come = sorted((each for each in attacks if each.kind in AT_ONCE), key=lambda each: each.start)
        on_bytes = [each for each in attacks if each.kind not in AT_ONCE | ON_MOTORS | ON_TIME]
        self._again = {each: each.start for each in attacks if each.kind in ON_TIME}
        for each in attacks:
            prepare(each, self)
        self._wakes = min(
            (each.start - LOOK_BACK_S * (each.kind == Kind.REPLAY) for each in on_bytes), default=math.inf
        )
        self._sleeps = max((each.end for each in on_bytes), default=-math.inf)

    def undo(self) -> None:
        """Undo the attacks' changes to the servos."""
        while self._undo:
            self._undo.pop()()

    def stand_still(self, seconds: float) -> None:
        """Suspend the program for a duration [s]; meanwhile, other programs may attack the servos."""
        until = self.clock.now() + seconds
        for each in [each for each in self._to_come if each.start <= until and each.kind not in ON_PROGRAM]:
            self._to_come.remove(each)
            self.clock.wait_until(max(each.start, self.clock.now()))
            self.bus.advance(self.clock.now())
            self._undo += happen(each, self)
        self.clock.wait_until(until)

    # What the program calls

    def write(self, data: bytes | bytearray) -> int:  # type: ignore[override]
        now = self.clock.now()
        self._strike(now)
        self.traffic.passed.append((now, False, bytes(data)))
        if not self._wakes <= now <= self._sleeps:
            return super().write(data)
        self._request = request_in(bytes(data)) or self._request
        told = [told for packet in packets_of(bytes(data)) for told in self._instruction(packet, now)]
        if told:
            super().write(b"".join(told))
        if any(self._strikes(each, now) for each in self._lasting(now, {Kind.ECHO})):
            self._queue.append((now, bytes(data)))
        return len(data)

    def read(self, size: int = 1) -> bytes:
        now = self.clock.now()
        self._strike(now)
        if self._wakes <= now <= self._sleeps or self._queue or self._raw:
            taken = self._read_changed(size)
        else:
            taken = super().read(size)
        self.traffic.passed.append((self.clock.now(), True, taken))
        self._strike(self.clock.now())
        return taken

    @property
    def in_waiting(self) -> int:
        now = self.clock.now()
        self._let_rivals_write(now)
        return super().in_waiting + sum(len(data) for due, data in self._queue if due <= now)

    def reset_input_buffer(self) -> None:
        super().reset_input_buffer()
        now = self.clock.now()
        self._raw.clear()
        self._queue = deque((due, data) for due, data in self._queue if due > now)

    # Replies

    def _read_changed(self, size: int) -> bytes:
        clock, queue = self.clock, self._queue
        deadline = clock.now() + (self.timeout or 0.0)
        taken = b""
        while len(taken) < size:
            now = clock.now()
            if queue and queue[0][0] <= now:
                due, data = queue.popleft()
                count = size - len(taken)
                taken += data[:count]
                if data[count:]:
                    queue.appendleft((due, data[count:]))
                continue
            until = min(deadline, queue[0][0] if queue else math.inf)
            if self.bus.on_the_way:
                self.timeout, kept = max(0.0, until - now), self.timeout
                try:
                    byte = super().read(1)
                finally:
                    self.timeout = kept
                if byte:
                    self._take(byte)
                    continue
            elif self._raw:
                self._give_up_waiting()
            else:
                clock.wait_until(until)
                if not self.is_open or self.bus.cable_is_out:
                    super().read(0)
            if clock.now() >= deadline and not (queue and queue[0][0] <= clock.now()):
                break
        return taken

    def _take(self, byte: bytes) -> None:
        """Take a byte from the servos; if it completes a packet, pass on the packet as changed by the attacks."""
        raw = self._raw
        raw += byte
        if len(raw) >= 7 and raw.startswith(HEADER):
            if len(raw) < 7 + (raw[5] | raw[6] << 8):
                return
        elif HEADER.startswith(bytes(raw[:4])):
            return
        packet = bytes(raw)
        raw.clear()
        now = self.clock.now()
        due = self._queue[-1][0] if self._queue else now
        for wait, data in self._changed(packet, now):
            due = max(due, now + wait)
            self._queue.append((due, data))

    def _give_up_waiting(self) -> None:
        """Pass on an incomplete packet whose rest will never arrive; otherwise, it would be taken for a late packet."""
        now = self.clock.now()
        self._queue.append((max(now, self._queue[-1][0]) if self._queue else now, bytes(self._raw)))
        self._raw.clear()

    def _changed(self, packet: bytes, now: float) -> Iterator[tuple[float, bytes]]:
        """Yield what a reply is turned into: pairs of a delay [s] and bytes."""
        servo_id = packet[4] if len(packet) > 4 else None
        packet = self._forger.keep_and_forge(packet, self._request, now, self._forging(now))
        wait, copies, gap = 0.0, 1, None
        for each in self._lasting(now, ON_REPLIES):
            if servo_id not in (None, 0xFE) and not each.concerns(servo_id):
                continue
            if not self._strikes(each, now):
                continue
            match each.kind:
                case Kind.HOLD:
                    wait += each.amount
                case Kind.SPLIT:
                    gap = each.amount
                case Kind.DROP:
                    copies = 0
                case Kind.REPEAT:
                    copies *= 2
                case _:
                    packet = self._spoilt(each, packet)
        for _ in range(copies if packet else 0):
            if gap is None:
                yield wait, packet
            else:
                half = self._random.randrange(1, max(2, len(packet)))
                yield wait, packet[:half]
                yield wait + gap, packet[half:]

    def _one_behind(self, packet: bytes) -> bytes:
        key = packet[4] if len(packet) > 4 else -1, len(packet)
        former, self._former[key] = self._former.get(key, packet), packet
        return former

    def _reordered(self, packet: bytes) -> bytes:
        """Hold back the first servo's answer until the last one has arrived; a fast answer is a single packet."""
        ids = self._request.ids if self._request is not None else ()
        if len(packet) < 11 or len(ids) < 2 or packet[4] not in ids:
            return packet
        if packet[4] == ids[0]:
            self._held = packet
            return b""
        held, self._held = self._held, None
        return packet + held if held is not None else packet

    def _forging(self, now: float) -> list[Attack]:
        return [each for each in self._lasting(now, FORGED) if self._strikes(each, now)]

    def _spoilt(self, attack: Attack, packet: bytes) -> bytes:
        """Replace the packet by another one, or corrupt its bytes so that no checksum matches."""
        if attack.kind == Kind.ONE_BEHIND:
            return self._one_behind(packet)
        if attack.kind == Kind.REORDERED:
            return self._reordered(packet)
        if attack.kind == Kind.CUT:
            at = self._random.randrange(len(packet))
            return packet[:at] + packet[at + self._random.randrange(1, 5) :]
        if attack.kind == Kind.COLLISION:
            return self._collided(packet)
        return self._flipped(packet, max(1, round(attack.amount)))

    def _flipped(self, data: bytes, bits: int) -> bytes:
        changed = bytearray(data)
        for _ in range(bits if changed else 0):
            changed[self._random.randrange(len(changed))] ^= 1 << self._random.randrange(8)
        return bytes(changed)

    def _collided(self, data: bytes) -> bytes:
        """Combine a reply with another servo's simultaneous reply: a bit is low if either servo pulls the line low."""
        other = encode_status(data[4], 0, self._random.randbytes(max(0, len(data) - 11))) if len(data) > 4 else b""
        return bytes(own & its for own, its in zip(data, other.ljust(len(data), b"\xff"), strict=False))

    # Instructions

    def _instruction(self, packet: bytes, now: float) -> Iterator[bytes]:
        is_goal = len(packet) > 7 and packet[7] == 0x83
        copies = 1
        for each in self._lasting(now, ON_INSTRUCTIONS):
            if (each.kind in (Kind.DEAF_TO_GOALS, Kind.GOAL_FIGHT) and not is_goal) or not self._strikes(each, now):
                continue
            if each.kind == Kind.GOAL_FIGHT:
                self._fights.append(each)
            elif each.kind == Kind.DEAF_TO_GOALS and each.servo is not None:
                packet = without_goal(packet, each.servo)
            else:
                copies = copies * 2 if each.kind == Kind.TWICE_TOLD else 0
        for _ in range(copies if packet else 0):
            yield packet

    # What happens once

    def _strike(self, now: float) -> None:
        if self.dead:
            raise Killed
        if self._fights and not self.bus.on_the_way:
            for each in self._fights:
                overwrite_goals(each, self)
            self._fights.clear()
        self._let_rivals_write(now)
        for each, due in self._again.items():
            if each.kind == Kind.HICCUPS and due <= now < each.end and not self.over and not self.bus.on_the_way:
                self._again[each] = now + each.amount + HICCUP_EVERY_S
                self.clock.wait_until(now + each.amount)
        while self._to_come and self._to_come[0].start <= now:
            each = self._to_come.pop(0)
            if not self.over:
                self._undo += happen(each, self)

    def _let_rivals_write(self, now: float) -> None:
        """Let other masters write when their writes are due, even between two calls by the program."""
        if not self._again:
            return
        for each in [each for each in self._again if each.kind == Kind.RIVAL and not self.over]:
            while self._again[each] <= min(now, each.end) and not self.bus.on_the_way:
                self.bus.advance(self._again[each])
                overwrite_goals(each, self)
                self._again[each] += RIVAL_EVERY_S

    def _lasting(self, now: float, kinds: frozenset[Kind] | set[Kind]) -> Iterator[Attack]:
        if self.over:
            return
        for each in self._attacks:
            if each.kind in kinds and each.start <= now < each.end:
                yield each

    def _strikes(self, attack: Attack, _now: float) -> bool:
        return attack.chance >= 1.0 or self._random.random() < attack.chance


Opened = Callable[[Middle], None]
