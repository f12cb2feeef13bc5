"""A half-duplex serial bus with fake servos and the plant they drive, on the bus's own clock.

Bytes take wire time (ten bits each). A packet takes effect when its last byte arrives: the plant is advanced to that
moment with the previous motor currents, then the addressed servos act. Replies start after the servo's return delay and
reach the host `adapter_latency_us` later. When the host writes, everything up to the last packet of that write is
computed, even if it lies ahead of the clock. Between two packets, the plant is also advanced to each time at which a
Bus Watchdog, the servos' own loops or a fault acts.

When host and servo, or two servos with different IDs, transmit at the same time, the later packet and the rest of the
earlier one are lost. Which servos act and reply is decided in `hil.fakes.bus.instructions`.
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
from hil.fakes.plants.plant import HasRotors, Plant
from hil.fakes.servo.present import PRESENT_END, PRESENT_START
from hil.fakes.servo.servo import EmulatedServo

GAP_S = 1.5e-3
"""Pause between two bytes of a packet after which a servo discards the incomplete packet [s]."""

TICK_S = 1e-3
"""Period of the servos' own loops [s]."""


class FakeBus:
    """The wire, the adapter, the servos and the plant.

    joints: for each servo, the index of the plant joint that it moves; by default, servo i moves joint i. Two servos
    may move the same joint.

    The plant's time is 0 when the bus is created. Times in this class are in seconds on `clock`, except `time` and the
    times of faults, which count from the creation of the bus.
    """

    def __init__(
        self,
        servos: Sequence[EmulatedServo],
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
        """Number of valid packets sent by the host."""
        self.pulls = 0
        """Number of times the adapter's cable was unplugged. A port that was open at that moment must be reopened."""
        self.cable_is_out = False
        self.pulled_at = -math.inf
        """Time on `clock` at which the cable was last unplugged [s]."""
        self._servos = tuple(servos)
        self._joints = Joints(servos, plant, joints)
        self._rotors = plant if isinstance(plant, HasRotors) else None
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
        self.faults = Faults(seed, self._begin_fault, self._end_fault, lambda: self.advance(self.clock.now()))
        self._instructions = Instructions(self._servos, self)
        for joint, servo in zip(self._joints.of, self._servos, strict=True):
            servo.power_up(self._now, lambda joint=joint: self.plant.position[joint])  # type: ignore[misc]
            servo.changed = self._servo_changed
        self._servo_changed()

    @property
    def baud(self) -> int:
        """The host's baud rate. Servos set to another rate cannot decode anything and stay silent.

        If it is changed while a reply is being received, the rest arrives as garbage, as read by a receiver at the
        wrong rate.
        """
        return self._wire.baud

    @baud.setter
    def baud(self, baud: int) -> None:
        if baud != self._wire.baud:
            self._wire.change_baud(baud, self.clock.now())

    @property
    def servos(self) -> dict[int, EmulatedServo]:
        """Servos by current ID, advanced to the clock's current time; of servos with the same ID, only the last."""
        self.advance(self.clock.now())
        return {servo.id: servo for servo in self._servos}

    @property
    def hand(self) -> Hand:
        """The hand that moves joints whose torque is off, advanced to the clock's current time."""
        self.advance(self.clock.now())
        return self._hand

    @property
    def time(self) -> float:
        """Seconds since the bus was created, on its clock."""
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
        """Number of packets from the host with a wrong CRC."""
        return self._receiver.damaged

    # The host's side

    def write(self, data: bytes) -> None:
        """Put bytes on the wire, after those still being sent. The new bytes are lost if the cable is unplugged."""
        wire, receiver = self._wire, self._receiver
        now = self.clock.now()
        if now - self._origin >= self.faults.next_change:
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
        """Return up to `size` bytes, waiting on the clock for at most `timeout_s` (0: only what has already arrived).

        An infinite wait (`math.inf`) ends when all bytes in transit have arrived, or when the cable is unplugged.
        """
        now = self.clock.now()
        deadline = now + timeout_s
        if timeout_s > 0 and deadline <= now:
            # Advance time even when the timeout is too small to change the sum, so that a client polling in a loop
            # until its timeout expires does not loop forever.
            deadline = math.nextafter(now, math.inf)
        taken = b""
        while True:
            change = self._origin + self.faults.next_change
            part, came = self._wire.take(size - len(taken), deadline if deadline < change else change, now)
            taken = taken + part if taken else part
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
        """Number of bytes that have reached the host but have not been read."""
        return self._wire.count_by(self.clock.now())

    @property
    def on_the_way(self) -> int:
        """Number of bytes that have reached the host or will reach it without another write."""
        return self._wire.on_the_way

    @property
    def sent_by(self) -> float:
        """Time on `clock` at which the last byte written by the host has been sent [s]."""
        return self._sent_by

    @property
    def next_reply_by(self) -> float:
        """Time on `clock` when the next contiguous group of replies will have arrived [s]; infinite if none is due."""
        return self._wire.next_reply_by

    def discard_input(self) -> None:
        """Drop the bytes that have reached the host. Those in transit arrive later, as on a real port."""
        now = self.clock.now()
        self._wire.take(self.in_waiting, now, now)

    # Time

    def notice_faults(self) -> None:
        """Start or end the faults that are due by now."""
        now = self.clock.now()
        if now - self._origin >= self.faults.next_change:
            self.advance(now)
            if now - self._origin >= self.faults.next_change:  # the bus was already ahead of the clock
                self._change_faults(now)

    def advance(self, until: float) -> None:
        """Advance plant, servos and faults to the time `until` [s]; do nothing if that is in the past."""
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
        """Advance in stages that end at each tick, fault and watchdog trip, so that these affect the plant at once."""
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
        # A sum of times may be too small by a rounding error; a fault that is due must not stay due forever.
        self.faults.change(max(now - self._origin, self.faults.next_change))

    def _tick(self, now: float) -> None:
        state = self.joints()
        if self._supply is not None:
            self._supply.load(self._servos, state[2], now)
        for servo, position, velocity, current, turning in zip(
            self._servos, *state, self._rotor_velocities(state[1]), strict=True
        ):
            if servo.needs_ticks:
                servo.tick(TICK_S, position, velocity, current, turning)
        if self._hand.busy:
            self._hand.tick(now - self._origin)

    def _rotor_velocities(self, velocities: Sequence[float]) -> Sequence[float]:
        """Velocities of the rotors, one per servo [rad/s]. velocities: those of the output shafts."""
        if self._rotors is None:
            return velocities
        turning = self._rotors.rotor_velocity
        return [turning[joint] for joint in self._joints.of]

    def _move_plant(self, until: float) -> None:
        self.plant.advance(until - self._origin, self._joints.commands())
        self._now = until

    def _servo_changed(self) -> None:
        """Update routing and ticks after a change in a servo's ID or in its need for ticks."""
        self._instructions.route()
        self._ticks_wanted()

    def _ticks_wanted(self) -> None:
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
        """Simulate another master that reads a Present Position; the host receives both request and reply."""
        request = encode(servo_id, Instruction.READ, b"\x84\x00\x04\x00")
        asked_by = self._wire.put(request, self._now)
        self._instructions.receive(Packet(servo_id, Instruction.READ, request[8:-2]), asked_by)

    # The servos' side

    def _receive(self, packet: Packet, now: float) -> None:
        self.advance(now)
        self.packets += not packet.damaged
        if self.faults.on_instructions:
            self._receive_with_faults(packet, now)
        else:
            self._instructions.receive(packet, now)

    def _receive_with_faults(self, packet: Packet, now: float) -> None:
        """Receive a packet, subject to faults; a servo affected by a fault also misses broadcast packets."""
        deaf: set[int] = set()
        for fault in self.faults.on_instructions:
            if not self.faults.strikes(fault, packet.id if fault.servo is None else fault.servo, now - self._origin):
                continue
            if fault.kind == FaultKind.CORRUPTED_INSTRUCTION and fault.servo in (None, packet.id):
                packet = packet._replace(damaged=True)
            elif fault.servo is None:
                return
            else:
                deaf.add(fault.servo)
        cut_off = [servo for servo in self._servos if servo.connected and servo.id in deaf]
        for servo in cut_off:
            servo.connected = False
        try:
            self._instructions.receive(packet, now)
        finally:
            for servo in cut_off:
                servo.connected = True

    def send(self, replies: Sequence[Reply], now: float) -> None:
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
            joined += data  # replies without a pause between them are sent as one block
        if joined:
            wire.put(joined, now)

    def measure(self, servo: EmulatedServo, address: int, length: int) -> None:
        end_address = address + length
        if (address < PRESENT_END and end_address > PRESENT_START) or servo.memory.is_indirect(address, length):
            index = self._index[servo]
            position, velocity, current = self.joints()
            servo.present.measure(address, end_address, self._now, position[index], velocity[index], current[index])

    def joints(self) -> States:
        if self._one_each:
            plant = self.plant
            return plant.position, plant.velocity, plant.current
        return self._joints.states()

    def is_moving(self, servo: EmulatedServo) -> bool:
        """Return whether the servo's register Moving is 1."""
        return servo.present.moves(self.plant.velocity[self._joints.of[self._index[servo]]])

    @property
    def servos_refuse(self) -> bool:
        return bool(self.faults.on_answers)

    def fault_error(self, servo: EmulatedServo, now: float) -> int:
        """Return the ERR byte of this servo's replies while a fault is active; 0 if none is."""
        return self.faults.error(servo.id, now - self._origin)

    def count_collision(self) -> None:
        """Count a collision of servos with the same ID."""
        self._wire.collisions += 1
