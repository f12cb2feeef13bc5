"""Our exchange and dynamixel-sdk's group classes: identical requests and values for random packets.

Cases in which the SDK is known to be wrong are left out: what it sends is never stuffed, and some stuffed replies are
misread (see test_packet).
"""

import struct
from collections.abc import Sequence
from typing import Any

from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler
from hypothesis import assume, given
from hypothesis import strategies as st

from hil.drivers.control_table import load_control_table
from hil.drivers.exchange import Exchange
from hil.drivers.packet import HEADER, crc, encode_status
from hil.drivers.port import Port
from hil.drivers.servo_model import Mode
from hil.drivers.state import spans

XM430 = load_control_table("XM430-W350")


class Both(Port):
    """A scripted wire for both clients: a Port for ours, a port handler for the SDK."""

    is_using = False

    def __init__(self, answer: bytes = b"") -> None:
        self.url, self.baud, self.is_open, self.latency = "scripted", 1_000_000, True, 1e-3
        self.clock = self  # type: ignore[assignment]
        self.time = 0.0
        self.sent = b""
        self.waiting = answer
        self.overheard = b""

    def now(self) -> float:
        self.time += 1.0
        return self.time

    def write(self, data: bytes) -> None:
        self.sent += data

    def read(self, count: int, timeout: float) -> bytes:
        taken, self.waiting = self.waiting[:count], self.waiting[count:]
        return taken

    def has_input(self) -> bool:
        return False  # the reply is available before the request

    def discard_input(self) -> None:
        pass

    def clearPort(self) -> None:
        pass

    def getBaudRate(self) -> int:
        return self.baud

    def writePort(self, packet: Sequence[int]) -> int:
        self.sent += bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:
        return self.read(length, 0.0)

    def setPacketTimeout(self, length: int) -> None:
        pass

    def isPacketTimeout(self) -> bool:
        return not self.waiting


def ours(wire: Both, ids: Sequence[int], *, fast: bool) -> Exchange:
    return Exchange(wire, ids, XM430["Goal Current"], spans(Mode.CURRENT, [XM430]), 0.0, fast=fast)


def sdk_read(wire: Both, ids: Sequence[int]) -> Any:
    read = GroupSyncRead(wire, PacketHandler(2.0), 126, 10)
    for servo_id in ids:
        read.addParam(servo_id)
    return read


id_lists = st.lists(st.integers(0, 252), min_size=1, max_size=8, unique=True)
ticks16, ticks32 = st.integers(-(2**15), 2**15 - 1), st.integers(-(2**31), 2**31 - 1)
servos = st.dictionaries(st.integers(0, 252), st.tuples(ticks16, ticks32, ticks32), min_size=1, max_size=6)


@given(st.dictionaries(st.integers(0, 252), ticks16, min_size=1, max_size=8), st.booleans())
def test_the_requests_are_the_sdks_bytes(goals: dict[int, int], fast: bool) -> None:
    mine, theirs = Both(), Both()
    ours(mine, list(goals), fast=fast).cycle(list(goals.values()))
    write = GroupSyncWrite(theirs, PacketHandler(2.0), 102, 2)
    for servo_id, goal in goals.items():
        write.addParam(servo_id, struct.pack("<h", goal))
    write.txPacket()
    read = sdk_read(theirs, list(goals))
    read.fastSyncReadTxPacket() if fast else read.txPacket()
    assert mine.sent == theirs.sent


@given(servos)
def test_both_read_the_same_values_from_status_packets(states: dict[int, tuple[int, int, int]]) -> None:
    data = {servo_id: struct.pack("<hii", *state) for servo_id, state in states.items()}
    assume(not any(b"\xff\xff\xfd" in each for each in data.values()))  # the SDK misreads some of these
    answer = b"".join(encode_status(servo_id, 0, each) for servo_id, each in data.items())
    mine = ours(Both(answer), list(states), fast=False).cycle([0] * len(states)).servos
    assert mine == [(0, *state) for state in states.values()]
    read = sdk_read(Both(answer), list(states))
    assert read.txRxPacket() == 0
    assert_same(read, states)


def assert_same(read: Any, states: dict[int, tuple[int, int, int]]) -> None:
    for servo_id, state in states.items():
        seen = [read.getData(servo_id, *place) for place in ((126, 2), (128, 4), (132, 4))]
        assert seen == [value % 2**bits for value, bits in zip(state, (16, 32, 32), strict=True)]


@given(servos)
def test_both_read_the_same_values_from_a_fast_answer(states: dict[int, tuple[int, int, int]]) -> None:
    answer = HEADER + b"\xfe" + (1 + 14 * len(states)).to_bytes(2, "little") + b"\x55"
    for servo_id, state in states.items():
        answer += bytes((0, servo_id)) + struct.pack("<hii", *state)
        answer += crc(answer).to_bytes(2, "little")
    mine = ours(Both(answer), list(states), fast=True).cycle([0] * len(states)).servos
    assert mine == [(0, *state) for state in states.values()]
    read = sdk_read(Both(answer), list(states))
    assert read.fastSyncRead() == 0
    assert_same(read, states)
