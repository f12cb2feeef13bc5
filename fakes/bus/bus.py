"""A half-duplex serial bus with fake servos on it and a plant behind them, in the bus's own time.

Bytes take wire time (ten bits each). A packet acts when its last byte arrives: the plant is advanced to that moment
with the motor currents in force before, then the addressed servos act. Replies go onto the wire after the servo's
return delay and reach the host `adapter_latency_us` later. Everything is worked out when the host writes, up to the
last packet of that write, even where that lies ahead of the clock; between two packets only Bus Watchdogs, the servos'
own loops and faults can act, and the plant's advance is split at the moment they do.

When two speak at once, host and servo or two servos, both are lost: the later packet, and the former's bytes from there
on. Which servos act and answer is decided in `hil.fakes.bus.instructions`.
"""

import math
from collections.abc import Sequence

from hil.drivers.clock import Clock
from hil.drivers.packet import Instruction, Packet, encode
from hil.fakes.bus.fault_effects import begin, end, put_with_faults
from hil.fakes.bus.faults import Fault, FaultKind, Faults
from hil.fakes.bus.hand import Hand
from hil.fakes.bus.instructions import Instructions
from hil.fakes.bus.joints import Joints, States
from hil.fakes.bus.receiver import Receiver
from hil.fakes.bus.supply import Supply
from hil.fakes.bus.sync_reads import Reply
from hil.fakes.bus.wire import Wire
from hil.fakes.plants.plant import Plant
from hil.fakes.servo.present import PRESENT_END, PRESENT_START
from hil.fakes.servo.servo import Servo

GAP_S = 1.5e-3
"""A pause between two bytes of a packet after which a servo forgets its beginning [s]."""

TICK_S = 1e-3
"""Period of the servos' own loops [s]."""


class FakeBus:
    """The wire, the adapter and everything behind it. Servo `i` of the sequence moves joint `i` of the plant, or where
    `joints` is given joint `joints[i]`, so that two of them may move one.

    The plant's time is 0 when the bus is made. Times in this class are seconds on `clock`, but for `time` and those of
    faults, which count from when the bus was made.
    """

    def __init__(
        self,
        servos: Sequence[Servo],
        plant: Plant,
        clock: Clock,
        *,
        joints: Sequence[int] | None = None,
        baud: int = 1_000_000,
        adapter_latency_us: float = 0.0,
        adapter_echoes: bool = False,
        supply: Supply | None = None,
        seed: int = 0,
    ) -> None:
        self.plant = plant
        self.clock = clock
        self.packets = 0
        """Good packets that the host has sent."""
        self.pulls = 0
        """How often the adapter's cable was pulled. What was open then stays lost."""
        self.cable_is_out = False
        self.pulled_at = -math.inf
        """When the cable was pulled last."""
        self._servos = tuple(servos)
        self._joints = Joints(servos, plant, joints)
        self._one_each = self._joints.one_each
        self._supply = supply
        self._wire = Wire(baud, adapter_latency_us * 1e-6)
        self._echoes = adapter_echoes
        self._receiver = Receiver()
        self._origin = self._now = clock.now()
        self._sent_by = self._now
        self._next_tick = math.inf
        self._index = {servo: index for index, servo in enumerate(self._servos)}
        self._hand = Hand(self._joints, plant, lambda: self.clock.now() - self._origin, self._ticks_wanted)
        self.faults = Faults(seed, self._begin_fault, self._end_fault)
        self._instructions = Instructions(self._servos, self)
        for joint, servo in zip(self._joints.of, self._servos, strict=True):
            servo.power_up(self._now, lambda joint=joint: self.plant.position[joint])  # type: ignore[misc]
            servo.changed = self._servo_changed
        self._servo_changed()

    @property
    def baud(self) -> int:
        """The host's baud. Servos set to another rate understand nothing and stay silent.

        Set while a reply is on its way, what is left of it arrives as the garbage that a receiver makes of it.
        """
        return self._wire.baud

    @baud.setter
    def baud(self, baud: int) -> None:
        if baud != self._wire.baud:
            self._wire.change_baud(baud, self.clock.now())

    @property
    def servos(self) -> dict[int, Servo]:
        """The servos by their present ID, in the state they have at the clock's present time."""
        self.advance(self.clock.now())
        return {servo.id: servo for servo in self._servos}

    @property
    def hand(self) -> Hand:
        """Moves joints whose torque is off; as it is at the clock's present time."""
        self.advance(self.clock.now())
        return self._hand

    @property
    def time(self) -> float:
        """Seconds since the bus was made, by its clock."""
        return self.clock.now() - self._origin

    @property
    def advanced_to(self) -> float:
        """The time up to which plant and servos have been advanced [s on the clock]."""
        return self._now

    @property
    def collisions(self) -> int:
        """Number of collisions between host and servos, or between two servos."""
        return self._wire.collisions

    @property
    def damaged_packets(self) -> int:
        """Packets of the host whose CRC was wrong."""
        return self._receiver.damaged

    # The host's side

    def write(self, data: bytes) -> None:
        """Put bytes on the wire, behind those still being sent. With the cable out they are lost."""
        wire, receiver = self._wire, self._receiver
        now = self.clock.now()
        self.notice_faults()
        if self.cable_is_out:
            return
        start = now if now > self._sent_by else self._sent_by
        if receiver.pending and start - self._sent_by > GAP_S:
            receiver.reset()
        byte_s = wire.byte_s
        end_s = self._sent_by = start + len(data) * byte_s
        if self._echoes:
            wire.echo(data, start)
        for packet, behind in receiver.feed(data):
            arrived = end_s - behind * byte_s
            if start >= wire.reply_by or not wire.collide(start, arrived):
                self._receive(packet, arrived)
            start = arrived

    def read(self, size: int, timeout_s: float) -> bytes:
        """Up to `size` bytes, waiting on the clock until they are there, at most `timeout_s` (0: take what is there).

        Nothing but the host's own writing brings new bytes, so a wait without end (`math.inf`) is over when all bytes
        on their way have come. The wait is over too when the cable is pulled.
        """
        now = self.clock.now()
        deadline = now + timeout_s
        if timeout_s > 0:
            # Time moves on even when the timeout is too short to change the sum: a client that waits in a loop for the
            # end of its timeout gets there.
            deadline = max(deadline, math.nextafter(now, math.inf))
        taken = b""
        while True:
            change = self._origin + self.faults.next_change
            part, came = self._wire.take(size - len(taken), min(deadline, change), now)
            taken += part
            if len(taken) == size or deadline < change or self.cable_is_out or change == math.inf:
                break
            self.clock.wait_until(change)
            self.notice_faults()
            now = self.clock.now()
        if not self.cable_is_out:
            self.clock.wait_until(deadline if len(taken) < size and deadline < math.inf else came)
        return taken

    @property
    def in_waiting(self) -> int:
        """Bytes that have reached the host and were not read."""
        return self._wire.count_by(self.clock.now())

    @property
    def on_the_way(self) -> int:
        """Bytes that have reached the host or will do so without further writing."""
        return self._wire.on_the_way

    @property
    def sent_by(self) -> float:
        """When the last byte that the host wrote has left it."""
        return self._sent_by

    @property
    def next_reply_by(self) -> float:
        """When the replies that are next to come, one directly after the other, will all be there; infinite if none."""
        return self._wire.next_reply_by

    def discard_input(self) -> None:
        """Drop the bytes that have reached the host. Those still on their way come later, as they do on a real port."""
        now = self.clock.now()
        self._wire.take(self.in_waiting, now, now)

    # Time

    def notice_faults(self) -> None:
        """Trigger the faults that are due by the clock."""
        now = self.clock.now()
        if now - self._origin >= self.faults.next_change:
            self.advance(now)
            if now - self._origin >= self.faults.next_change:  # the bus was ahead of the clock already
                self._change_faults(now)

    def advance(self, until: float) -> None:
        """Move plant, servos and faults on to `until`; nothing when that is past."""
        if until <= self._now:
            return
        event = until >= self._next_tick or until - self._origin >= self.faults.next_change
        commands = []
        for servo in self._servos:
            commands.append(servo.motor_current_a)
            if servo.watchdog_s and until > servo.heard_at + servo.watchdog_s:
                event = True
        if event:
            self._advance_by_events(until)
        elif self._one_each:
            self.plant.advance(until - self._origin, commands)
            self._now = until
        else:
            self._move_plant(until)

    def _advance_by_events(self, until: float) -> None:
        """Stop at each tick, fault and watchdog's trip, so that the plant sees its effect from that moment on."""
        while self._now < until:
            counting = [servo for servo in self._servos if servo.watchdog_s]
            trip = min((servo.heard_at + servo.watchdog_s for servo in counting), default=math.inf)
            change = self._origin + self.faults.next_change
            moment = max(min(until, trip, change, self._next_tick), self._now)
            self._move_plant(moment)
            for servo in counting:
                if moment >= servo.heard_at + servo.watchdog_s and until > moment:
                    servo.trip_watchdog()
            if moment >= change:
                self._change_faults(moment)
            if moment >= self._next_tick:
                self._next_tick = moment + TICK_S
                self._tick(moment)

    def _change_faults(self, now: float) -> None:
        # A sum of times may fall short of them by a rounding; what is due must not be due again and again.
        self.faults.change(max(now - self._origin, self.faults.next_change))

    def _tick(self, now: float) -> None:
        state = self.joints()
        if self._supply is not None:
            self._supply.load(self._servos, state[2], now)
        for servo, position, velocity, current in zip(self._servos, *state, strict=True):
            if servo.needs_ticks:
                servo.tick(TICK_S, position, velocity, current)
        if self._hand.busy:
            self._hand.tick(now - self._origin)

    def _move_plant(self, until: float) -> None:
        self.plant.advance(until - self._origin, self._joints.commands())
        self._now = until

    def _servo_changed(self) -> None:
        """A servo has another ID, or needs ticks, or needs none any more."""
        self._instructions.route()
        self._ticks_wanted()

    def _ticks_wanted(self) -> None:
        """Begin or end to tick, as servos and hand need it."""
        if self._supply is None and not self._hand.busy and not any(servo.needs_ticks for servo in self._servos):
            self._next_tick = math.inf
        elif self._next_tick == math.inf:
            self._next_tick = self._now + TICK_S

    def _begin_fault(self, fault: Fault) -> None:
        if fault.kind == FaultKind.CABLE_PULLED:
            self.cable_is_out = True
            self.pulls += 1
            self.pulled_at = max(self._origin + fault.at, self.clock.now())
            self._wire.cut(self.pulled_at)
        elif fault.kind == FaultKind.OTHER_MASTER:
            self._other_master_speaks(self._servos[0].id if fault.servo is None else fault.servo)
        else:
            begin(fault, self._servos, self._joints.of, self.plant, self._now)

    def _end_fault(self, fault: Fault) -> None:
        if fault.kind == FaultKind.CABLE_PULLED:
            self.cable_is_out = False
        else:
            end(fault, self._servos, self._joints.of, self.plant)

    def _other_master_speaks(self, servo_id: int) -> None:
        """Another master reads a servo's Present Position; the host receives both request and reply."""
        request = encode(servo_id, Instruction.READ, b"\x84\x00\x04\x00")
        asked_by = self._wire.put(request, self._now)
        self._instructions.receive(Packet(servo_id, Instruction.READ, request[8:-2]), asked_by)

    # The servos' side

    def _receive(self, packet: Packet, now: float) -> None:
        self.advance(now)
        self.packets += not packet.damaged
        for fault in self.faults.on_instructions:
            if self.faults.strikes(fault, packet.id, now - self._origin):
                if fault.kind == FaultKind.LOST_INSTRUCTION:
                    return
                packet = packet._replace(damaged=True)
        self._instructions.receive(packet, now)

    def send(self, replies: Sequence[Reply], now: float) -> None:
        """Put replies on the wire, each its delay after the end of the one before it; the first after `now`."""
        wire, faults = self._wire, self.faults
        if faults.on_replies:
            for servo_id, delay_s, data in replies:
                now = put_with_faults(faults, wire, servo_id, data, now + delay_s, now - self._origin)
            return
        joined = b""
        for _, delay_s, data in replies:
            if delay_s:
                if joined:
                    now = wire.put(joined, now)
                joined = b""
                now += delay_s
            joined += data  # what follows without a pause is one stretch of bytes
        if joined:
            wire.put(joined, now)

    def measure(self, servo: Servo, address: int, length: int) -> None:
        """Bring the registers of a stretch up to date with the servo's joint."""
        end_address = address + length
        if (address < PRESENT_END and end_address > PRESENT_START) or servo.memory.is_indirect(address, length):
            index = self._index[servo]
            position, velocity, current = self.joints()
            servo.present.measure(address, end_address, self._now, position[index], velocity[index], current[index])

    def joints(self) -> States:
        """Positions [rad], velocities [rad/s] and motor currents [A] of the servos' joints, one each per servo."""
        if self._one_each:
            plant = self.plant
            return plant.position, plant.velocity, plant.current
        return self._joints.states()

    def is_moving(self, servo: Servo) -> bool:
        """Whether the servo's register Moving is 1."""
        return servo.present.moves(self.plant.velocity[self._joints.of[self._index[servo]]])

    @property
    def servos_refuse(self) -> bool:
        """Whether an active fault makes servos refuse commands."""
        return bool(self.faults.on_answers)

    def fault_error(self, servo: Servo, now: float) -> int:
        """The ERR byte with which a fault has a servo answer."""
        return self.faults.error(servo.id, now - self._origin)

    def count_collision(self) -> None:
        """Two servos with one ID have answered at once."""
        self._wire.collisions += 1
