"""Precomputed group reads of the control cycle.

These requests read Present Current, Velocity and Position of several servos, or registers without measurements, such as
goals. The replies are the same as those of the general path in `hil.fakes.bus.instructions`, but are computed in half
the time.
"""

import functools
from collections.abc import Mapping, Sequence
from struct import Struct
from typing import NamedTuple, Protocol

from hil.drivers.packet import ALERT, BROADCAST_ID, HEADER, MAX_LENGTH, Instruction, crc, encode_status
from hil.fakes.servo.present import PRESENT_END, PRESENT_START, STATE_END, STATE_START
from hil.fakes.servo.servo import EmulatedServo

Reply = tuple[int, float, bytes]
"""One servo's reply: its ID, its delay [s], and the bytes."""

MOST_PREPARED = 1000
"""Maximum number of different requests that are cached."""

_PLACE_LENGTH = 4  # address and length of a group read, before the IDs
_FRONT_LENGTH = 8  # header, ID, LEN, INST of a status
_STUFFED = b"\xff\xff\xfd"
_ALERT = {0: b"\0", ALERT: bytes((ALERT,))}
_pack_crc = Struct("<H").pack


class JointStates(Protocol):
    """Source of the joints' states."""

    def joints(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]: ...


class _Part(NamedTuple):
    servo: EmulatedServo
    place: int
    """Index among all servos."""
    front: bytes
    """Beginning of the servo's status packet: header, ID, LEN, INST."""
    id_byte: bytes


class _Request(NamedTuple):
    """A request and its servos. parts: empty if the request needs the general path."""

    parts: tuple[_Part, ...]
    address: int
    length: int
    is_of_state: bool
    """Whether the group read covers the joint state, rather than registers that only a write can change."""


class GroupReads:
    """Cache of received requests and their servos. `forget` must be called whenever an ID has changed."""

    def __init__(self, servos: Sequence[EmulatedServo], joints: JointStates) -> None:
        self._servos = tuple(servos)
        self._joints = joints
        self._prepared: dict[bytes, _Request] = {}

    def forget(self) -> None:
        """Clear the cache, since the servos' IDs have changed."""
        self._prepared.clear()

    def sync_read(self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]], now: float) -> list[Reply] | None:
        """Return the replies to a Sync Read; None if it needs the general path."""
        request = self._prepared.get(body) or self._prepare(body, by_id)
        told = self._told(request, now)
        if told is None:
            return None
        replies = []
        for (servo, _, front, _), data in zip(request.parts, told, strict=True):
            if _STUFFED in data:
                reply = encode_status(servo.id, servo.alert, data)
            else:
                reply = front + _ALERT[servo.alert] + data
                reply += _pack_crc(crc(reply))
            replies.append((servo.id, servo.return_delay_s, reply))
        return replies

    def fast_sync_read(
        self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]], now: float
    ) -> list[Reply] | None:
        """Return the parts of the reply to a Fast Sync Read; None if it needs the general path."""
        request = self._prepared.get(body) or self._prepare(body, by_id)
        told = self._told(request, now, fast=True)
        if told is None:
            return None
        whole = _fast_front(len(request.parts), request.length)
        replies = []
        sent = 0
        for (servo, _, _, id_byte), data in zip(request.parts, told, strict=True):
            whole += _ALERT[servo.alert] + id_byte + data
            whole += _pack_crc(crc(whole))
            replies.append((servo.id, servo.return_delay_s, whole[sent:]))
            sent = len(whole)
        return replies

    def _told(self, request: _Request, now: float, *, fast: bool = False) -> list[bytes] | None:
        """Return the register bytes in each servo's answer; None if the request needs the general path."""
        parts, address, length, is_of_state = request
        if is_of_state:
            positions, velocities, currents = self._joints.joints()
        told = []
        for servo, place, _, _ in parts:
            if servo.heard_at != now or not servo.status_return_level or (fast and not servo.has_fast_reads):
                return None
            if is_of_state:
                told.append(servo.present.state(positions[place], velocities[place], currents[place]))
                continue
            data = servo.memory.read_plain(address, length)
            if data is None:
                return None
            told.append(data)
        return told or None

    def _prepare(self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]]) -> _Request:
        if len(self._prepared) >= MOST_PREPARED:
            self._prepared.clear()
        address, length = body[0] | body[1] << 8, body[2] | body[3] << 8
        is_of_state = address == STATE_START and address + length == STATE_END
        parts: tuple[_Part, ...] = ()
        if is_of_state or address + length <= PRESENT_START or address >= PRESENT_END:
            parts = self._parts(body[_PLACE_LENGTH:], length, by_id)
        request = self._prepared[body] = _Request(parts, address, length, is_of_state)
        return request

    def _parts(self, ids: bytes, length: int, by_id: Mapping[int, Sequence[EmulatedServo]]) -> tuple[_Part, ...]:
        """Return the parts of a request; empty if it needs the general path.

        That is the case if a servo is absent, if two have the same ID, if a model is not fully known, or if a fast
        reply would be too long.
        """
        parts: list[_Part] = []
        if 1 + len(ids) * (length + 4) > MAX_LENGTH:
            return ()
        for servo_id in ids:
            servos = by_id.get(servo_id, ())
            if len(servos) != 1 or not servos[0].model.operating_modes:
                return ()
            front = encode_status(servo_id, 0, bytes(length))[:_FRONT_LENGTH]
            parts.append(_Part(servos[0], self._servos.index(servos[0]), front, bytes((servo_id,))))
        return tuple(parts)


@functools.cache
def _fast_front(servos: int, length: int) -> bytes:
    """Return the beginning of the reply to a fast read of `length` bytes per servo: header, ID, LEN, INST."""
    size = 1 + servos * (length + 4)
    return HEADER + bytes((BROADCAST_ID, size & 0xFF, size >> 8, Instruction.STATUS))
