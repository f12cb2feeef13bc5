"""Precomputed group reads of the control cycle: Present Current, Velocity and Position of several servos.

They return the same bytes as the general path in `hil.fakes.bus.instructions`, in half the time; a fake bus spends most
of its time here.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from hil.drivers.packet import ALERT, BROADCAST_ID, HEADER, Instruction, crc, encode_status
from hil.fakes.servo.present import STATE_END, STATE_START
from hil.fakes.servo.servo import EmulatedServo

Reply = tuple[int, float, bytes]
"""One servo's reply: its ID, its delay [s], and the bytes."""

SPAN = STATE_START.to_bytes(2, "little") + (STATE_END - STATE_START).to_bytes(2, "little")
"""Beginning of the body of such a read: address and length."""

MOST_PREPARED = 1000
"""Number of different requests that are cached."""

MOST_SERVOS = 64
"""Number of servos that fit into one fast read (LEN is at most 1024)."""

_SIZE = STATE_END - STATE_START
_FRONT_LENGTH = 8  # header, ID, LEN, INST of a status
_STUFFED = b"\xff\xff\xfd"
_ALERT = {0: b"\0", ALERT: bytes((ALERT,))}


class JointStates(Protocol):
    """Source of the joints' states."""

    def joints(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Return position [rad], velocity [rad/s] and motor current [A] of the joints, one value per servo."""
        ...


class _Part(NamedTuple):
    servo: EmulatedServo
    place: int
    """Index among all servos."""
    front: bytes
    """Beginning of the servo's status packet: header, ID, LEN, INST."""
    id_byte: bytes


class StateReads:
    """Cache of the requests received, each with its servos. `forget` must be called whenever an ID has changed."""

    def __init__(self, servos: Sequence[EmulatedServo], joints: JointStates) -> None:
        self._servos = tuple(servos)
        self._joints = joints
        self._prepared: dict[bytes, tuple[_Part, ...]] = {}

    def forget(self) -> None:
        """Clear the cache, since the servos' IDs have changed."""
        self._prepared.clear()

    def sync_read(self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]], now: float) -> list[Reply] | None:
        """Return the replies to a Sync Read; None if it needs the general path."""
        parts = self._parts(body, by_id)
        positions, velocities, currents = self._joints.joints()
        replies = []
        for servo, place, front, _ in parts:
            if servo.heard_at != now or not servo.status_return_level:
                return None
            state = servo.present.state(positions[place], velocities[place], currents[place])
            if _STUFFED in state:
                reply = encode_status(servo.id, servo.alert, state)
            else:
                reply = front + _ALERT[servo.alert] + state
                reply += crc(reply).to_bytes(2, "little")
            replies.append((servo.id, servo.return_delay_s, reply))
        return replies or None

    def fast_sync_read(
        self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]], now: float
    ) -> list[Reply] | None:
        """Return the parts of the reply to a Fast Sync Read; None if it needs the general path."""
        parts = self._parts(body, by_id)
        positions, velocities, currents = self._joints.joints()
        whole = _fast_front(len(parts))
        replies = []
        sent = 0
        for servo, place, _, id_byte in parts:
            if servo.heard_at != now or not servo.status_return_level or not servo.has_fast_reads:
                return None
            state = servo.present.state(positions[place], velocities[place], currents[place])
            whole = b"".join((whole, _ALERT[servo.alert], id_byte, state))
            whole += crc(whole).to_bytes(2, "little")
            replies.append((servo.id, servo.return_delay_s, whole[sent:]))
            sent = len(whole)
        return replies or None

    def _parts(self, body: bytes, by_id: Mapping[int, Sequence[EmulatedServo]]) -> tuple[_Part, ...]:
        parts = self._prepared.get(body)
        if parts is None:
            if len(self._prepared) >= MOST_PREPARED:
                self._prepared.clear()
            parts = self._prepared[body] = self._prepare(body[len(SPAN) :], by_id)
        return parts

    def _prepare(self, ids: bytes, by_id: Mapping[int, Sequence[EmulatedServo]]) -> tuple[_Part, ...]:
        """Return the parts of a request; empty if it needs the general path.

        That is the case if a servo is absent, if two have the same ID, or if a model is not fully known.
        """
        parts: list[_Part] = []
        if len(ids) > MOST_SERVOS:
            return ()
        for servo_id in ids:
            servos = by_id.get(servo_id, ())
            if len(servos) != 1 or not servos[0].model.operating_modes:
                return ()
            front = encode_status(servo_id, 0, bytes(_SIZE))[:_FRONT_LENGTH]
            parts.append(_Part(servos[0], self._servos.index(servos[0]), front, bytes((servo_id,))))
        return tuple(parts)


@functools.cache
def _fast_front(servos: int) -> bytes:
    """Beginning of the reply to a fast read of this many servos: header, ID, LEN, INST."""
    size = 1 + servos * (_SIZE + 4)
    return HEADER + bytes((BROADCAST_ID, size & 0xFF, size >> 8, Instruction.STATUS))
