"""The control cycle against a scripted wire: what it sends, and what it makes of stuffed, missing and late bytes."""

import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.control_table import load_control_table
from drivers.errors import PortLost
from drivers.exchange import Exchange
from drivers.packet import Framer, Instruction, encode_status
from drivers.port import Port

XM430 = load_control_table("XM430-W350")


class Wire(Port):
    """A port whose answers are set beforehand and whose clock moves by the time that reads wait."""

    def __init__(self, answers: Sequence[bytes] = ()) -> None:
        self.url, self.baud, self.is_open = "scripted", 1_000_000, True
        self.time = 0.0
        self.clock = self
        self.answers = list(answers)
        self.waiting = b""
        self.written: list[bytes] = []

    def now(self) -> float:
        return self.time

    def wait_until(self, deadline: float) -> None:
        self.time = max(self.time, deadline)

    def write(self, data: bytes | bytearray) -> None:
        self.written.append(bytes(data))
        self.waiting += self.answers.pop(0) if self.answers else b""

    def read(self, count: int, timeout: float) -> bytes:
        taken, self.waiting = self.waiting[:count], self.waiting[count:]
        self.time += timeout if len(taken) < count else 1e-5
        return taken

    def discard_input(self) -> None:
        self.waiting = b""


def answer(servo_id: int, current: int, velocity: int, position: int, error: int = 0) -> bytes:
    return encode_status(servo_id, error, struct.pack("<hii", current, velocity, position))


def exchange(wire: Wire, ids: Sequence[int] = (1, 2)) -> Exchange:
    return Exchange(wire, ids, [XM430] * len(ids), return_delay=0.0)


def test_one_write_carries_both_packets() -> None:
    wire = Wire()
    exchange(wire).cycle([5, -3])
    assert len(wire.written) == 1
    write, read = Framer().feed(wire.written[0])
    assert (write.id, write.instruction) == (0xFE, Instruction.SYNC_WRITE)
    assert write.body == struct.pack("<HHBhBh", 102, 2, 1, 5, 2, -3)
    assert (read.id, read.instruction) == (0xFE, Instruction.SYNC_READ)
    assert read.body == struct.pack("<HHBB", 126, 10, 1, 2)


ticks16 = st.integers(-(2**15), 2**15 - 1)
ticks32 = st.integers(-(2**31), 2**31 - 1)
states = st.tuples(ticks16, ticks32, ticks32, st.integers(0, 255))


@given(st.lists(states, min_size=1, max_size=6), st.integers(0, 3))
def test_every_answer_is_read_back_also_when_stuffed_and_behind_noise(
    servos: list[tuple[int, int, int, int]], noise: int
) -> None:
    ids = range(1, len(servos) + 1)
    wire = Wire([b"\x55" * noise + b"".join(answer(i, *servo) for i, servo in zip(ids, servos, strict=True))])
    reply = exchange(wire, list(ids)).cycle([0] * len(servos))
    assert [(s.current_ticks, s.velocity_ticks, s.position_ticks, s.error) for s in reply.servos if s] == servos


def test_a_stuffed_answer_is_understood() -> None:
    # Present Current -1 before a velocity whose low byte is FD: FF FF FD inside the packet.
    wire = Wire([answer(1, -1, 0xFD, 7) + answer(2, 1, 2, 3)])
    assert b"\xff\xff\xfd\xfd" in wire.answers[0]
    first, second = exchange(wire).cycle([0, 0]).servos
    assert first is not None and second is not None
    assert (first.current_ticks, first.velocity_ticks, first.position_ticks) == (-1, 0xFD, 7)
    assert second.position_ticks == 3


def test_a_silent_servo_is_missing_and_the_other_is_kept() -> None:
    reply = exchange(Wire([answer(2, 1, 2, 3)])).cycle([0, 0])
    assert reply.servos[0] is None
    assert reply.servos[1] is not None and reply.servos[1].position_ticks == 3


def test_a_damaged_answer_is_missing() -> None:
    damaged = bytearray(answer(1, 1, 2, 3))
    damaged[12] ^= 0x40
    reply = exchange(Wire([bytes(damaged) + answer(2, 1, 2, 4)])).cycle([0, 0])
    assert reply.servos[0] is None
    assert reply.servos[1] is not None and reply.servos[1].position_ticks == 4


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    wire = Wire([b"", answer(1, 0, 0, 20) + answer(2, 0, 0, 21)])
    cycle = exchange(wire).cycle
    assert list(cycle([0, 0]).servos) == [None, None]
    wire.waiting = answer(1, 0, 0, 10) + answer(2, 0, 0, 11)  # comes after the timeout, with a good CRC
    assert [servo.position_ticks for servo in cycle([0, 0]).servos if servo] == [20, 21]


def test_a_cycle_without_answers_is_bounded() -> None:
    wire = Wire()
    exchange(wire).cycle([0, 0])
    assert wire.time < 0.05


def test_error_bytes_are_kept() -> None:
    reply = exchange(Wire([answer(1, 0, 0, 0, error=0x80) + answer(2, 0, 0, 0)])).cycle([0, 0])
    assert [servo.error for servo in reply.servos if servo] == [0x80, 0]


def test_servos_that_do_not_share_addresses_are_refused() -> None:
    other = load_control_table("H54-100-S500-RA")
    with pytest.raises((ValueError, KeyError)):
        Exchange(Wire(), (1, 2), [XM430, other], 0.0)


def test_a_lost_port_is_not_hidden() -> None:
    class Lost(Wire):
        def write(self, data: bytes | bytearray) -> None:
            raise PortLost("gone")

    with pytest.raises(PortLost):
        exchange(Lost()).cycle([0, 0])
