"""The control cycle on a scripted wire: its requests, and its handling of valid, stuffed, missing and late replies."""

import math
import struct
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.drivers.control_table import load_control_table
from hil.drivers.errors import PortLost
from hil.drivers.exchange import Exchange
from hil.drivers.packet import HEADER, Framer, Instruction, crc, encode, encode_status
from hil.drivers.port import Port
from hil.drivers.read_back_exchange import ReadBackExchange
from hil.drivers.servo_model import Mode
from hil.drivers.state import spans
from hil.drivers.sync_read import FastSyncRead, Span, SyncRead

XM430 = load_control_table("XM430-W350")
XL430 = load_control_table("XL430-W250")


class Wire(Port):
    """A port with scripted replies, whose clock advances by the time that reads wait."""

    def __init__(self, answers: Sequence[bytes] = ()) -> None:
        self.url, self.baud, self.is_open, self.latency = "scripted", 1_000_000, True, 1e-3
        self.time = 0.0
        self.clock = self
        self.answers = list(answers)
        self.waiting = b""
        self.written: list[bytes] = []
        self.overheard = b""

    def now(self) -> float:
        return self.time

    def wait_until(self, deadline: float) -> None:
        self.time = max(self.time, deadline)

    def write(self, data: bytes) -> None:
        self.written.append(data)
        self.waiting += self.answers.pop(0) if self.answers else b""

    def has_input(self) -> bool:
        return bool(self.waiting)

    def read(self, count: int, timeout: float) -> bytes:
        taken, self.waiting = self.waiting[:count], self.waiting[count:]
        self.time += timeout if len(taken) < count else 1e-5
        return taken

    def discard_input(self) -> None:
        self.waiting = b""

    def put_aside(self) -> None:
        self.overheard, self.waiting = self.waiting, b""


def state(current: int, velocity: int, position: int) -> bytes:
    return struct.pack("<hii", current, velocity, position)


def answer(servo_id: int, current: int, velocity: int, position: int, error: int = 0) -> bytes:
    return encode_status(servo_id, error, state(current, velocity, position))


def fast_answer(*servos: tuple[int, int, bytes]) -> bytes:
    """Return one packet with the parts of several servos, (ID, ERR, data) each, encoded as in the manual."""
    length = 1 + sum(len(data) + 4 for _, _, data in servos)
    packet = HEADER + bytes((0xFE,)) + length.to_bytes(2, "little") + b"\x55"
    for servo_id, error, data in servos:
        packet += bytes((error, servo_id)) + data
        packet += crc(packet).to_bytes(2, "little")
    return packet


def exchange(
    wire: Wire, ids: Sequence[int] = (1, 2), *, fast: bool = False, one_write: bool = True, interval: float = 0.0
) -> ReadBackExchange:
    every, goal = spans(Mode.CURRENT, [XM430] * len(ids)), XM430["Goal Current"]
    how: dict[str, Any] = {"fast": fast, "one_write": one_write, "interval": interval, "slow_every": 10}
    return ReadBackExchange(wire, ids, goal, every, 0.0, **how)


# What is sent


def test_one_write_carries_both_packets() -> None:
    wire = Wire()
    exchange(wire).cycle([5, -3])
    assert len(wire.written) == 1
    write, read = Framer().feed(wire.written[0])
    assert (write.id, write.instruction) == (0xFE, Instruction.SYNC_WRITE)
    assert write.body == struct.pack("<HHBhBh", 102, 2, 1, 5, 2, -3)
    assert (read.id, read.instruction) == (0xFE, Instruction.SYNC_READ)
    assert read.body == struct.pack("<HHBB", 126, 10, 1, 2)


def test_two_writes_carry_the_same_bytes() -> None:
    one, two = Wire(), Wire()
    exchange(one).cycle([5, -3])
    exchange(two, one_write=False).cycle([5, -3])
    assert len(two.written) == 2
    assert b"".join(two.written) == one.written[0]


@given(st.lists(st.tuples(st.integers(0, 252), st.integers(-(2**15), 2**15 - 1)), min_size=1, max_size=8))
def test_goals_are_never_stuffed_whatever_they_are(servos: list[tuple[int, int]]) -> None:
    wire = Wire()
    exchange(wire, [servo_id for servo_id, _ in servos]).cycle([goal for _, goal in servos])
    write, _ = Framer().feed(wire.written[0])
    assert write.body == struct.pack("<HH", 102, 2) + b"".join(struct.pack("<Bh", *servo) for servo in servos)
    assert len(wire.written[0]) == 14 + 3 * len(servos) + 14 + len(servos)


@pytest.mark.parametrize("goals", [[1], [1, 2, 3], [40_000, 0], [0.5, 0]])
def test_goals_that_cannot_be_sent_are_not_sent(goals: list[int]) -> None:
    wire = Wire()
    with pytest.raises(ValueError, match=r"goals|size"):
        exchange(wire).cycle(goals)
    assert wire.written == []


# What comes back


@pytest.mark.parametrize("fast", [False, True])
def test_what_another_master_sends_and_asks_for_is_counted_and_ones_own_late_replies_are_not(fast: bool) -> None:
    own = fast_answer((1, 0, state(1, 2, 3)), (2, 0, state(4, 5, 6))) if fast else answer(1, 1, 2, 3)
    refusal = encode_status(1, 7)
    foreign = [
        encode(1, Instruction.READ, b"\x84\x00\x04\x00"),
        encode_status(1, 0, b"\0\x08\0\0"),
        encode_status(9, 0, bytes(10)),
    ]
    cut_off = [own[:12] + packet for packet in foreign]  # where two transmissions meet, the first loses its end
    for received, count in ((own, 0), (refusal, 0), (own[:-3], 0), *((packet, 1) for packet in foreign + cut_off)):
        exchanging = exchange(Wire([received]), fast=fast)
        exchanging.cycle([0, 0])
        assert exchanging.heard.strangers == count, received.hex()


ticks16 = st.integers(-(2**15), 2**15 - 1)
ticks32 = st.integers(-(2**31), 2**31 - 1)
alerts = st.sampled_from([0, 0x80])
answers = st.lists(st.tuples(alerts, ticks16, ticks32, ticks32), min_size=1, max_size=6)


@given(answers, st.integers(0, 3))
def test_every_answer_is_read_back_also_when_stuffed_and_behind_noise(
    servos: list[tuple[int, int, int, int]], noise: int
) -> None:
    ids = range(1, len(servos) + 1)
    wire = Wire([b"\x55" * noise + b"".join(answer(i, *s[1:], s[0]) for i, s in zip(ids, servos, strict=True))])
    assert exchange(wire, list(ids)).cycle([0] * len(servos)).servos == servos


@given(answers, st.integers(0, 3))
@settings(max_examples=50)
def test_every_fast_answer_is_read_back(servos: list[tuple[int, int, int, int]], noise: int) -> None:
    ids = range(1, len(servos) + 1)
    parts = [(i, error, state(*ticks)) for i, (error, *ticks) in zip(ids, servos, strict=True)]
    wire = Wire([b"\x55" * noise + fast_answer(*parts)])
    assert exchange(wire, list(ids), fast=True).cycle([0] * len(servos)).servos == servos


@pytest.mark.parametrize("fast", [False, True])
def test_the_usual_answer_is_unpacked_at_once_without_a_search(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def search(*_: object) -> None:
        raise AssertionError("searched")

    monkeypatch.setattr(SyncRead, "search", search)
    monkeypatch.setattr(FastSyncRead, "search", search)
    separate = answer(1, 3, 2, 1) + answer(2, -1, 4, 5, 0x80)
    wire = Wire([fast_answer((1, 0, state(3, 2, 1)), (2, 0x80, state(-1, 4, 5))) if fast else separate])
    assert exchange(wire, fast=fast).cycle([0, 0]).servos == [(0, 3, 2, 1), (0x80, -1, 4, 5)]


def test_answers_in_another_order_are_accepted_only_where_that_is_allowed() -> None:
    first, second = answer(1, 3, 2, 1), answer(2, -1, 4, 5)
    assert exchange(Wire([second + first])).cycle([0, 0]).servos == [None, None]
    for received in (second + first, first + first + second):
        any_order = exchange(Wire([received]))
        any_order.accept_any_order()
        assert any_order.cycle([0, 0]).servos == [(0, 3, 2, 1), (0, -1, 4, 5)]
    mixed_up = exchange(Wire([first + answer(1, 7, 7, 7) + second]))
    mixed_up.accept_any_order()
    assert mixed_up.cycle([0, 0]).servos == [None, None], "two different answers with one ID"


def test_a_fast_answer_from_other_servos_is_not_believed() -> None:
    wire = Wire([fast_answer((1, 0, state(3, 2, 1)), (3, 0, state(-1, 4, 5)))])
    assert exchange(wire, fast=True).cycle([0, 0]).servos == [(0, 3, 2, 1), None]


def test_a_stuffed_answer_is_understood() -> None:
    # Present Current -1 before a velocity whose low byte is FD: FF FF FD inside the packet.
    wire = Wire([answer(1, -1, 0xFD, 7) + answer(2, 1, 2, 3)])
    assert b"\xff\xff\xfd\xfd" in wire.answers[0]
    assert exchange(wire).cycle([0, 0]).servos == [(0, -1, 0xFD, 7), (0, 1, 2, 3)]
    assert wire.time < 1e-3, "once it is complete, no further byte is awaited"


@pytest.mark.parametrize("fast", [False, True])
def test_the_slow_registers_come_in_turn(fast: bool) -> None:
    class Echo(Wire):
        """Answer each request with as many bytes of value 7 as it expects."""

        def write(self, data: bytes) -> None:
            super().write(data)
            size = list(Framer().feed(data))[1].body[2]
            self.waiting = fast_answer((1, 0, b"\7" * size)) if fast else encode_status(1, 0, b"\7" * size)

    wire = Echo()
    every_tenth = exchange(wire, [1], fast=fast)
    replies = [every_tenth.cycle([0]) for _ in range(40)]
    assert [index for index, reply in enumerate(replies) if reply.span] == [9, 19, 29, 39]
    assert [replies[index].span for index in (9, 19, 29, 39)] == [1, 2, 1, 2]
    asked = {tuple(list(Framer().feed(written))[1].body[:3]) for written in wire.written}
    assert asked == {(126, 0, 10), (120, 0, 16), (126, 0, 21)}
    tick = next(reply.servos[0] for reply in replies if reply.span == 1)
    assert tick == (0, 0x0707, 0x0707, 0x07070707, 0x07070707)


def test_a_silent_servo_is_missing_and_the_other_is_kept() -> None:
    assert exchange(Wire([answer(2, 1, 2, 3)])).cycle([0, 0]).servos == [None, (0, 1, 2, 3)]


def test_behind_a_silent_servo_a_fast_answer_breaks_off_and_what_came_before_is_kept() -> None:
    whole = fast_answer((1, 0, state(1, 2, 3)), (2, 0, state(4, 5, 6)))
    broken = whole[: 8 + 14]
    assert exchange(Wire([broken]), fast=True).cycle([0, 0]).servos == [(0, 1, 2, 3), None]


@pytest.mark.parametrize("at", range(21))
def test_a_damaged_answer_is_missing(at: int) -> None:
    damaged = bytearray(answer(1, 1, 2, 3))
    damaged[at] ^= 0x40
    servos = exchange(Wire([bytes(damaged) + answer(2, 1, 2, 4)])).cycle([0, 0]).servos
    assert servos == [None, (0, 1, 2, 4)]


@pytest.mark.parametrize("at", range(36))
def test_no_damaged_fast_answer_is_believed(at: int) -> None:
    damaged = bytearray(fast_answer((1, 0, state(1, 2, 3)), (2, 0, state(4, 5, 6))))
    damaged[at] ^= 0x40
    first, second = exchange(Wire([bytes(damaged)]), fast=True).cycle([0, 0]).servos
    assert first in (None, (0, 1, 2, 3))
    assert second is None


def test_a_refusal_is_told_from_silence() -> None:
    wire = Wire([encode_status(1, 0x07) + answer(2, 1, 2, 3)])
    assert exchange(wire).cycle([0, 0]).servos == [(7,), (0, 1, 2, 3)]


@pytest.mark.parametrize("late_by", ["before the next cycle", "during it"])
@pytest.mark.parametrize("fast", [False, True])
def test_a_late_answer_is_not_taken_for_the_next_one(late_by: str, fast: bool) -> None:
    late = answer(1, 0, 0, 10) + answer(2, 0, 0, 11)
    if fast:
        late = fast_answer((1, 0, state(0, 0, 10)), (2, 0, state(0, 0, 11)))
    data = [b"\x00" + state(0, 0, position) for position in (20, 21)]
    fresh = b"".join(encode_status(i, 0, d) for i, d in zip((1, 2), data, strict=True))
    if fast:
        fresh = fast_answer((1, 0, data[0]), (2, 0, data[1]))
    wire = Wire([b"", (late if late_by == "during it" else b"") + fresh])
    cycle = exchange(wire, fast=fast).cycle
    assert list(cycle([0, 0]).servos) == [None, None]
    if late_by == "before the next cycle":
        wire.waiting = late
    # The request after a loss asks for one more byte, so that replies to the lost one are recognised by their length.
    reply = cycle([0, 0])
    assert (reply.span, reply.servos) == (0, [(0, 0, 0, 20), (0, 0, 0, 21)])


def asked(wire: Wire) -> list[int]:
    """Number of bytes that each request asks of every servo."""
    reads = [packet for sent in wire.written for packet in Framer().feed(sent) if packet.instruction != 0x83]
    return [int.from_bytes(read.body[2:4], "little") for read in reads]


@pytest.mark.parametrize("modes", [Mode.CURRENT, Mode.PWM])
@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("cycles_late", [1, 2, 3, 4])
def test_replies_that_are_all_some_cycles_late_are_never_taken_for_new_ones(
    cycles_late: int, fast: bool, modes: Mode
) -> None:
    """Each arrives while the reply to another request is awaited; the positions show which request it belongs to."""
    tables = [XM430] * 2
    wire = Wire()
    cycles = Exchange(wire, (1, 2), XM430["Goal Current"], spans(modes, tables), 0.0, fast=fast, slow_every=1000)
    for _ in range(12):
        cycles.cycle([0, 0])
    every = asked(wire)
    for number, size in enumerate(every[:-cycles_late]):
        assert size != every[number + cycles_late], "a late reply has the length of the awaited one"
    wire = Wire([b""] * cycles_late + [_padded(size, at, fast) for at, size in enumerate(every)])
    cycles = Exchange(wire, (1, 2), XM430["Goal Current"], spans(modes, tables), 0.0, fast=fast, slow_every=1000)
    assert [list(cycles.cycle([0, 0]).servos) for _ in range(12)] == [[None, None]] * 12


def _padded(size: int, position: int, fast: bool) -> bytes:
    data = bytes(size - 4) + struct.pack("<i", position)
    if fast:
        return fast_answer((1, 0, data), (2, 0, data))
    return encode_status(1, 0, data) + encode_status(2, 0, data)


def test_after_a_loss_and_an_answer_the_usual_registers_are_asked_for_again() -> None:
    longer = b"\x00" + state(1, 1, 1)
    good = answer(1, 0, 0, 1) + answer(2, 0, 0, 1)
    wire = Wire([b"", encode_status(1, 0, longer) + encode_status(2, 0, longer), good, good])
    cycle = exchange(wire).cycle
    for _ in range(4):
        cycle([0, 0])
    assert asked(wire) == [10, 11, 10, 10]


@pytest.mark.parametrize(("count", "at_most_s"), [(2, 3e-3), (6, 4.5e-3)])
def test_a_cycle_without_answers_is_bounded(count: int, at_most_s: float) -> None:
    wire = Wire()
    exchange(wire, range(1, count + 1)).cycle([0] * count)
    assert 0.78e-3 < wire.time < at_most_s


def test_servos_and_adapter_are_given_the_time_that_they_may_take() -> None:
    wire = Wire()
    wire.latency = 16e-3
    slow = Exchange(wire, (1, 2), XM430["Goal Current"], spans(Mode.CURRENT, [XM430] * 2), 2e-3)
    slow.cycle([0, 0])
    on_the_wire = (20 + 16 + 42) * 10 / 1e6  # both requests, both answers
    needed = on_the_wire + 2 * 2e-3 + 16e-3
    assert needed < wire.time < needed + 1e-3


def test_alerts_are_kept() -> None:
    reply = exchange(Wire([answer(1, 0, 0, 0, error=0x80) + answer(2, 0, 0, 0)])).cycle([0, 0])
    assert [servo[0] for servo in reply.servos if servo] == [0x80, 0]


def test_a_lost_port_is_not_hidden() -> None:
    class Lost(Wire):
        def write(self, data: bytes) -> None:
            raise PortLost("gone")

    with pytest.raises(PortLost):
        exchange(Lost()).cycle([0, 0])


# Spans


def test_a_span_reads_over_the_registers_between_its_own() -> None:
    span = Span.of([XM430], ["Realtime Tick", "Present Current", "Present Position"])
    assert (span.address, span.size, span.format) == (120, 16, "Hxxxxhxxxxi")


def test_servos_that_do_not_share_addresses_are_refused() -> None:
    with pytest.raises(ValueError, match="XL320, XM430-W350"):
        Span.of([XM430, load_control_table("XL320")], ["Present Position"])


def test_under_pwm_the_applied_pwm_is_read_and_the_load_passed_over() -> None:
    every = spans(Mode.PWM, [XL430])
    assert (every[0].address, every[0].size, every[0].format) == (124, 12, "hxxii")
    assert every[2].format == "hxxiixxxxxxxxHB"


def test_another_masters_instructions_between_two_cycles_are_counted() -> None:
    """Late replies and noise, which may be pending as well, are not."""
    both = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    wire = Wire([both] * 3)
    cycles = exchange(wire)
    goal = encode(2, Instruction.WRITE, b"\x66\x00\x10\x00")
    for pending, count in ((answer(1, 1, 2, 3) + b"\xff\xfd", 0), (goal + answer(2, 0, 0, 0), 1), (b"", 1)):
        wire.waiting = pending
        assert None not in cycles.cycle([0, 0]).servos
        assert cycles.heard.strangers == count


@pytest.mark.parametrize(("front", "count"), [(8, 1), (12, 1), (7, 0), (4, 0)])
def test_an_instruction_of_another_master_that_ours_cuts_off_is_counted(front: int, count: int) -> None:
    fine = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    wire = Wire([encode(2, Instruction.WRITE, b"\x66\x00\x10\x00")[:front] + fine])
    cycles = exchange(wire)
    assert None not in cycles.cycle([0, 0]).servos
    assert cycles.heard.strangers == count


def test_a_damaged_reply_is_not_taken_for_a_part_of_an_instruction() -> None:
    whole = answer(1, 1, 2, 3)
    for start in range(len(whole)):
        for count in range(1, 5):
            for value in Instruction:  # where a part is lost, data may stand where the instruction is expected
                damaged = bytearray(whole[:9] + bytes((value,)) * 4 + whole[13:])
                del damaged[start : start + count]
                wire = Wire([bytes(damaged) + answer(2, 4, 5, 6)])
                cycles = exchange(wire)
                cycles.cycle([0, 0])
                assert not cycles.heard.strangers, (start, count, value)


def test_damaged_bytes_are_told_from_silence_and_late_replies_from_both() -> None:
    fine = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    for received, is_damaged in ((answer(1, 1, 2, 3), False), (b"", False), (fine[:-3] + b"abc", True)):
        wire = Wire([received])
        cycles = exchange(wire)
        assert None in cycles.cycle([0, 0]).servos
        assert math.isfinite(cycles.heard.damaged_at) is is_damaged and cycles.heard.late_at == -math.inf
    wire = Wire([b"", fine])
    cycles = exchange(wire)
    cycles.cycle([0, 0])
    wire.waiting = fine
    cycles.cycle([0, 0])
    assert math.isfinite(cycles.heard.late_at)


def echoed(wire: Wire, reply: bytes, goals: list[int]) -> bytes:
    """The reply behind an echo of what a cycle with these goals sends."""
    silent = Wire()
    exchange(silent).cycle(goals)
    return b"".join(silent.written) + reply


@pytest.mark.parametrize("one_write", [True, False])
def test_an_echo_is_removed_and_its_end_is_noticed(one_write: bool) -> None:
    reply = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    wire = Wire()
    wire.echoes = True
    bus = exchange(wire, one_write=one_write)
    told = [echoed(wire, reply, [7, 8])] * 5 + [reply] * 2
    wire.answers = told if one_write else [each for answered in told for each in (b"", answered)]
    wanted = [(0, 1, 2, 3), (0, 4, 5, 6)]
    times = []
    for _ in range(7):
        began = wire.time
        assert bus.cycle([7, 8]).servos == wanted
        times.append(wire.time - began)
    assert times[4] < 1e-4, "it waits for no more than echo and reply"
    assert times[5] > 1e-3 > 10 * times[6], "only one cycle waits for an echo that has ended"


@pytest.mark.parametrize(("share", "latest"), [(0.4, True), (0.6, False)])
def test_a_reply_sooner_than_the_wire_allows_gives_way_to_the_one_behind_it(share: float, latest: bool) -> None:
    class Paced(Wire):
        def read(self, count: int, timeout: float) -> bytes:
            taken = super().read(count, timeout)
            self.time += share * self.wire_time(17 + 15 + 14 + 2 * 21) if len(taken) == count else 0.0
            return taken

    former, present = answer(1, 1, 2, 3) + answer(2, 4, 5, 6), answer(1, 7, 8, 9) + answer(2, 7, 8, 9)
    wire = Paced([former + present])
    wire.time = 1.0
    assert exchange(wire).cycle([0, 0]).servos[0] == ((0, 7, 8, 9) if latest else (0, 1, 2, 3))


def test_without_slow_registers_only_the_usual_ones_are_read() -> None:
    reply = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    usual = spans(Mode.CURRENT, [XM430] * 2)[:1]
    bus = Exchange(Wire([reply] * 25), (1, 2), XM430["Goal Current"], usual, 0.0, slow_every=10)
    assert {bus.cycle([0, 0]).span for _ in range(25)} == {0}


def test_servos_with_different_goal_registers_each_receive_their_own_goal() -> None:
    wire = Wire()
    goals = (XM430["Goal Current"], XM430["Goal PWM"], XM430["Goal Current"])
    Exchange(wire, (1, 2, 3), goals, spans(Mode.CURRENT, [XM430] * 3), 0.0).cycle([10, 20, 30])
    sent = {
        (packet.body[0], packet.body[4:]) for packet in Framer().feed(wire.written[0]) if packet.body[2:4] == b"\2\0"
    }
    assert sent == {(102, b"\1\x0a\0\3\x1e\0"), (100, b"\2\x14\0")}
    with pytest.raises(ValueError, match="2 goals for 3 servos"):
        Exchange(wire, (1, 2, 3), goals, spans(Mode.CURRENT, [XM430] * 3), 0.0).cycle([10, 20])
