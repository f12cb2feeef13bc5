"""The control cycle on the wire: goal currents out, states in, one write and one bounded read.

A Sync Write has no reply, so the Sync Read that follows it leaves in the same write: one transaction of the adapter
instead of two. Both packets are prepared once; a cycle patches the goal currents and one CRC.
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

from drivers.clock import Clock
from drivers.control_table import ControlTable
from drivers.packet import BROADCAST_ID, Framer, Instruction, Packet, crc, encode
from drivers.port import ADAPTER_LATENCY_S, Port

_STATE = struct.Struct("<hii")  # Present Current, Present Velocity, Present Position
_REPLY = struct.Struct("<4sBHBBhiiH")  # header, ID, LEN, INST, ERR, the three above, CRC
_HEADER = b"\xff\xff\xfd\x00"
_REPLY_LENGTH = _STATE.size + 4  # INST, ERR, CRC


class ServoReply(NamedTuple):
    """One servo's answer, in ticks. `error` is the ERR byte: its low bits a StatusError, bit 7 the Alert."""

    error: int
    current_ticks: int
    velocity_ticks: int
    position_ticks: int


class Reply(NamedTuple):
    """One exchange: times on the port's clock [s] and one answer per servo, None where none came."""

    time_before_write: float
    time_after_read: float
    servos: Sequence[ServoReply | None]


class Exchange:
    """Sync Write of Goal Current and Sync Read of Present Current, Velocity and Position for a fixed list of servos.

    tables: each servo's control table; all must hold these registers at the same addresses.
    return_delay: the longest Return Delay Time of the servos [s].
    """

    def __init__(self, port: Port, ids: Sequence[int], tables: Sequence[ControlTable], return_delay: float) -> None:
        self._port = port
        self._clock: Clock = port.clock
        self.ids = tuple(ids)
        goal, first = tables[0]["Goal Current"], tables[0]["Present Current"]
        for table in tables:
            if table["Goal Current"] != goal or table["Present Current"] != first:
                raise ValueError(f"{table.model} and {tables[0].model} do not share addresses on one bus.")
        goals = b"".join(bytes((servo_id, 0, 0)) for servo_id in ids)
        header = goal.address.to_bytes(2, "little") + goal.size.to_bytes(2, "little")
        write = encode(BROADCAST_ID, Instruction.SYNC_WRITE, header + goals)
        span = first.address.to_bytes(2, "little") + _STATE.size.to_bytes(2, "little")
        read = encode(BROADCAST_ID, Instruction.SYNC_READ, span + bytes(ids))
        # Two-byte values between ID bytes can never hold FF FF FD, so the length of the Sync Write never changes.
        self._crc_at = len(write) - 2
        self._goals_at = [len(write) - 2 - 3 * len(ids) + 3 * index + 1 for index in range(len(ids))]
        self._request = bytearray(write + read)
        self._reply_size = _REPLY.size * len(ids)
        self.command_to_sample = port.wire_time(len(read))
        """Seconds from the goal currents' arrival at the servos to the arrival of the request for their state."""
        wire = port.wire_time(len(self._request) + self._reply_size + 4 * len(ids))
        self._timeout = wire + return_delay * len(ids) + ADAPTER_LATENCY_S
        self._late_possible = False

    def cycle(self, goal_current_ticks: Sequence[int]) -> Reply:
        """Send one goal current per servo and read all states. Raises PortLost; a silent servo is a None."""
        request = self._request
        for at, ticks in zip(self._goals_at, goal_current_ticks, strict=True):
            struct.pack_into("<h", request, at, ticks)
        struct.pack_into("<H", request, self._crc_at, crc(bytes(request[: self._crc_at])))
        if self._late_possible:
            # A reply that came after its timeout must not be taken for the answer to this request.
            self._port.discard_input()
            self._late_possible = False
        before = self._clock.now()
        self._port.write(request)
        received = self._port.read(self._reply_size, self._timeout)
        servos = self._unpack(received)
        if servos is None:
            servos = self._search(received, before + self._timeout)
        return Reply(before, self._clock.now(), servos)

    def _unpack(self, received: bytes) -> list[ServoReply | None] | None:
        """The usual case: every servo answered, no byte was stuffed. None when it is not that case."""
        if len(received) != self._reply_size:
            return None
        servos: list[ServoReply | None] = []
        size = _REPLY.size
        for index, servo_id in enumerate(self.ids):
            raw = received[index * size : (index + 1) * size]
            header, sender, length, instruction, error, current, velocity, position, check = _REPLY.unpack(raw)
            if (
                header != _HEADER
                or sender != servo_id
                or length != _REPLY_LENGTH
                or instruction != Instruction.STATUS
                or check != crc(raw[:-2])
            ):
                return None
            servos.append(ServoReply(error, current, velocity, position))
        return servos

    def _search(self, received: bytes, deadline: float) -> list[ServoReply | None]:
        """Find the answers among stuffed, damaged or missing ones, reading on until all are there or time is up."""
        framer = Framer()
        found: dict[int, ServoReply] = {}
        while True:
            for packet in framer.feed(received):
                reply = _reply_of(packet)
                if reply is not None and packet.id in self.ids:
                    found[packet.id] = reply
            remaining = deadline - self._clock.now()
            if len(found) == len(self.ids) or remaining <= 0:
                break
            # Byte by byte: how long a stuffed packet is shows only as it comes.
            received = self._port.read(1, remaining)
        self._late_possible = len(found) < len(self.ids)
        return [found.get(servo_id) for servo_id in self.ids]


def _reply_of(packet: Packet) -> ServoReply | None:
    if not packet.is_status or len(packet.data) != _STATE.size:
        return None
    return ServoReply(packet.error, *_STATE.unpack(packet.data))
