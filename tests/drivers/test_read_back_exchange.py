"""Read-backs between cycles on a scripted wire: when they take place, and what a lost or late one changes."""

import math
import struct

import pytest

from hil.drivers.exchange import HOST_S
from hil.drivers.others.read_back import GOALS, LOST_OF, TRY_AGAIN_S
from hil.drivers.packet import Framer, Instruction, encode, encode_status
from hil.drivers.read_back_exchange import ReadBackExchange
from hil.drivers.servo_model import Mode
from hil.drivers.state import read_back_spans
from hil.drivers.sync_read import Span, one_each
from hil.drivers.turns import Turns
from tests.drivers.test_exchange import XM430, Wire, answer, echoed, exchange
from tests.drivers.test_exchange import asked as bytes_asked

ONE_READ_BACK_S = 0.004
"""Time before a cycle that suffices for one read-back, but not for modes and goals."""


def read_back_of(wire: Wire, interval: float = 0.0) -> ReadBackExchange:
    cycles = exchange(wire, interval=interval)
    modes = [Mode.CURRENT, Mode.CURRENT]
    cycles.add_read_back(*read_back_spans(modes, [XM430, XM430]), [(0, mode, 0) for mode in modes], [(0,), (0,)])
    return cycles


def test_another_masters_instructions_before_a_read_back_are_counted() -> None:
    wire = Wire([answer(1, 1, 2, 3) + answer(2, 4, 5, 6)])
    cycles = read_back_of(wire)
    cycles.cycle([0, 0])
    wire.waiting = encode(2, Instruction.WRITE, b"\x66\x00\x10\x00")
    cycles.overruled(wire.now() + 0.1)
    assert cycles.heard.strangers == 1


@pytest.mark.parametrize("size", [None, 9])
def test_another_masters_instructions_instead_of_a_read_back_are_counted(size: int | None) -> None:
    wire = Wire([answer(1, 1, 2, 3) + answer(2, 4, 5, 6)])
    cycles = read_back_of(wire)
    cycles.cycle([0, 0])
    assert cycles._read_back is not None
    read = cycles._read_back.read
    reply = b"".join(encode_status(servo, 0, bytes(read.reply_size // 2 - 11)) for servo in (1, 2))
    wire.answers = [(encode(2, Instruction.WRITE, b"\x66\x00\x10\x00")[:size] + reply)[: read.reply_size]]
    cycles.overruled(wire.now() + 0.1)
    assert cycles.heard.strangers == 1


def test_modes_are_read_back_before_goals_if_there_is_time_for_both() -> None:
    for available, asked in ((ONE_READ_BACK_S, [1]), (0.1, [1, 0])):
        wire = Wire([answer(1, 1, 2, 3) + answer(2, 4, 5, 6)])
        cycles = read_back_of(wire)
        cycles.cycle([0, 0])
        assert cycles._read_back is not None
        reads = cycles._read_back.reads
        sizes = [own.reply_size // 2 - 11 for own in reads]
        wire.answers = [
            b"".join(encode_status(servo, 0, bytes(sizes[is_of_modes])) for servo in (1, 2)) for is_of_modes in asked
        ]
        wire.written.clear()
        assert cycles.overruled(wire.now() + available) is None and not cycles._late_possible
        assert wire.written == [reads[is_of_modes].request for is_of_modes in asked]


def test_a_lost_reply_or_a_long_cycle_delays_the_next_read_back_by_one_cycle_only() -> None:
    fine = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    wire = Wire([fine, b""])
    cycles = read_back_of(wire)
    for is_passing in (False, True):
        cycles.cycle([0, 0])
        before = wire.now()
        assert cycles.overruled(before + (1e-4 if not is_passing else 0.1)) is None
        assert cycles.read_back_at == (before if is_passing else before + TRY_AGAIN_S)


class Held(Wire):
    """A wire on which two servos answer every read with zeros, and at its end with the goal that they hold."""

    goal, is_silent = 0, False

    def write(self, data: bytes) -> None:
        reads = [each.body for each in Framer().feed(data) if each.instruction == Instruction.SYNC_READ]
        for body in [] if self.is_silent else reads:
            is_of_settings = body[0] | body[1] << 8 < 64
            told = bytes((body[2] | body[3] << 8) - 2) + struct.pack("<h", 0 if is_of_settings else self.goal)
            self.waiting += b"".join(encode_status(servo, 0, told) for servo in (1, 2))


@pytest.mark.parametrize("is_late", [False, True])
def test_goals_sent_while_a_reply_is_late_may_collide_with_it_and_are_not_counted_as_missed(is_late: bool) -> None:
    wire = Held()
    cycles = read_back_of(wire)
    for number in range(2 * LOST_OF):
        wire.goal = number
        if is_late:
            wire.is_silent = True
            cycles.cycle([number, number])
            wire.is_silent = False
        cycles.cycle([number + 1, number + 1])
        assert cycles.overruled(wire.now() + ONE_READ_BACK_S) is None
    assert (cycles.lost is None) is is_late


@pytest.mark.parametrize(("doubts_until", "pause"), [(0.0, TRY_AGAIN_S), (1.0, 0.0)])
def test_after_a_lost_reply_the_next_read_back_waits_unless_another_master_is_suspected(
    doubts_until: float, pause: float
) -> None:
    fine = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)
    wire = Wire([fine])
    cycles = read_back_of(wire)
    cycles.cycle([0, 0])
    assert cycles._read_back is not None
    cycles._read_back.doubts_until = doubts_until
    assert cycles.overruled(wire.now() + ONE_READ_BACK_S) is None
    assert cycles.read_back_at == pytest.approx(wire.now() + pause, abs=1e-9)


@pytest.mark.parametrize(("held", "is_due"), [(0, False), (5, True)])
def test_a_goal_that_was_not_taken_asks_for_the_status(held: int, is_due: bool) -> None:
    wire = Wire([answer(1, 1, 2, 3) + answer(2, 4, 5, 6)])
    cycles = read_back_of(wire)
    cycles._turns = Turns(slow_spans=2, slow_every=100, status_every=20)
    cycles._usual_left = cycles._turns.plan()
    cycles.cycle([0, 0])
    assert cycles._read_back is not None
    for is_of_modes in (True, False):
        data = bytes(cycles._read_back.read.reply_size // 2 - 13) + struct.pack("<h", 0 if is_of_modes else held)
        wire.answers = [b"".join(encode_status(servo, 0, data) for servo in (1, 2))]
        assert cycles.overruled(wire.now() + ONE_READ_BACK_S) is None
    assert cycles._usual_left == (0 if is_due else 18)


def test_goals_are_compared_with_what_was_sent_though_the_caller_changes_its_list() -> None:
    wire = Wire([answer(1, 1, 2, 3) + answer(2, 4, 5, 6)] * 30)
    cycles = read_back_of(wire)
    goals = [7, 8]
    for _ in range(4):
        cycles.cycle(goals)
    goals[:] = [70, 80]
    sizes = [one_each(span, 2)[0].size for span in read_back_spans([Mode.CURRENT] * 2, [XM430] * 2)]
    assert cycles._read_back is not None
    for _ in range(8):
        kind = cycles._read_back.kind
        held = (7, 8) if kind == GOALS else (0, 0)
        answers = [b"\1" + bytes(sizes[kind] - 3) + struct.pack("<h", each) for each in held]
        wire.answers = [b"".join(encode_status(servo, 0, each) for servo, each in enumerate(answers, 1))]
        assert cycles.overruled(wire.now() + 1.5 * HOST_S) is None and not wire.answers
        assert not cycles._late_possible and not cycles.is_in_doubt


def test_a_read_back_behind_an_echo_is_read_whole() -> None:
    wire = Wire()
    wire.echoes = True
    cycles = read_back_of(wire)
    wire.answers = [echoed(wire, answer(1, 1, 2, 3) + answer(2, 4, 5, 6), [7, 8])]
    cycles.cycle([7, 8])
    back = cycles._read_back
    assert back is not None and back.read is back.reads[1]
    _, mode, _ = read_back_spans([Mode.CURRENT] * 2, [XM430] * 2)
    assert isinstance(mode, Span)
    wire.answers = [back.read.request + b"".join(encode_status(servo, 0, bytes(mode.size)) for servo in (1, 2))]
    began = wire.time
    assert cycles.overruled(began + ONE_READ_BACK_S) is None
    assert not wire.waiting and not cycles._late_possible
    assert wire.time < began + ONE_READ_BACK_S, "it did not wait for more"


def test_its_attributes_stay_inside_the_object() -> None:
    """CPython keeps up to 29 there; with more, each access goes through a dictionary, which a cold cache lacks."""
    assert len(vars(read_back_of(Wire([])))) <= 29


def test_without_read_backs_or_a_known_interval_nothing_is_expected_of_them() -> None:
    off_wire = 2e-3
    assert exchange(Wire(), interval=0.0025).read_back_every(off_wire) == (0.0, 0.0)
    assert read_back_of(Wire()).read_back_every(off_wire) == (0.0, 0.0)
    assert read_back_of(Wire(), 0.0025).read_back_every(off_wire) > (0.0, 0.0)


def ready(wire: Wire, interval: float = 0.0) -> ReadBackExchange:
    """An exchange whose cycles take hardly longer than on the wire, since their replies are known to come soon."""
    wire.answers = [answer(1, 1, 2, 3) + answer(2, 4, 5, 6)] * 4
    cycles = read_back_of(wire, interval)
    for _ in range(4):
        cycles.cycle([0, 0])
    wire.written.clear()
    return cycles


@pytest.mark.parametrize(("left_s", "is_made"), [(0.0008, True), (0.0006, False)])
def test_a_read_back_needs_its_time_on_the_wire_when_this_program_wakes_up(left_s: float, is_made: bool) -> None:
    wire = Wire()
    cycles = ready(wire)  # next, the modes are read back, which takes 0.72 ms
    due = wire.now() + 0.0018
    wire.wait_until = lambda _: setattr(wire, "time", due - left_s)  # type: ignore[method-assign]
    assert cycles.overruled(due) is None and len(wire.written) == is_made


@pytest.mark.parametrize(("left_s", "asked"), [(0.00075, "all"), (0.00055, "one"), (0.00038, "goal"), (0.00025, "")])
def test_if_there_is_no_time_for_the_modes_a_goal_is_read_back(left_s: float, asked: str) -> None:
    """The modes of both servos take 0.72 ms on the wire, those of one 0.43 ms, and a goal 0.32 ms."""
    wire = Wire()
    cycles = ready(wire)
    back = cycles._read_back
    assert back is not None
    reads = {"all": back.read, "one": back.alone, "goal": back.shortest}
    assert cycles.overruled(wire.now() + left_s) is None
    assert wire.written == ([reads[asked].request] if asked else [])


@pytest.mark.parametrize(("left_s", "is_overdue", "waited_s"), [(0.002, True, 0.002), (0.0002, False, 0.0)])
def test_a_read_back_delays_the_next_cycle_only_if_overdue_and_without_time_before_it(
    left_s: float, is_overdue: bool, waited_s: float
) -> None:
    """Its reply is lost. The time by which any reply may be late is a fifth of a cycle."""
    wire = Wire()
    cycles = ready(wire, 0.0025)
    back = cycles._read_back
    assert back is not None
    if is_overdue:
        back.overdue_at = wire.now()
    began = wire.now()
    assert cycles.overruled(began + left_s) is None
    assert wire.now() - began <= waited_s + 0.2 * 0.0025 + 1e-9


def test_an_overdue_read_back_may_take_up_most_of_the_next_cycle() -> None:
    """Eight tenths of it, if its reply is lost."""
    wire = Wire()
    cycles = ready(wire, 0.0025)
    back = cycles._read_back
    assert back is not None
    due = wire.now() + 0.0002
    back.overdue_at = wire.now()
    asked = back.read.request
    assert cycles.awaited_until < wire.now()
    cycles.overruled(due)
    assert wire.written == [asked], "all servos are asked"
    assert wire.now() == pytest.approx(due + 0.8 * 0.0025)
    assert cycles.awaited_until == wire.now(), "the next cycle is late for this reason"


def test_a_read_back_for_which_there_is_barely_time_may_be_a_little_late() -> None:
    """By a fifth of a cycle; the modes take 0.72 ms on the wire."""
    wire = Wire()
    cycles = ready(wire, 0.0025)
    began = wire.now()
    cycles.overruled(began + 0.00075)
    assert wire.now() == pytest.approx(began + 0.00072 + 0.2 * 0.0025)


def reply_to(cycles: ReadBackExchange, *last: int) -> bytes:
    """Replies to the next read-back: zeros, except for the last byte of each servo."""
    assert cycles._read_back is not None
    zeros = bytes(cycles._read_back.read.reply_size // 2 - 12)
    return b"".join(encode_status(servo, 0, zeros + bytes((each,))) for servo, each in enumerate(last, 1))


def test_a_read_back_in_time_delays_nothing_and_shows_when_the_modes_were_right() -> None:
    wire = Wire()
    cycles = ready(wire)
    assert exchange(wire).modes_seen_ago == cycles.modes_seen_ago == math.inf
    wire.answers = [reply_to(cycles, 0, 0)]
    cycles.overruled(wire.now() + 0.0016)
    seen_at = wire.now()
    assert cycles.awaited_until == -math.inf
    wire.time += 0.5
    assert 0.5 <= cycles.modes_seen_ago == wire.now() - seen_at


def test_a_foreign_mode_is_read_again_in_the_next_cycle_not_in_the_same() -> None:
    wire = Wire()
    cycles = ready(wire)
    wire.answers = [reply_to(cycles, 0, 9)] * 2
    assert cycles.overruled(wire.now() + 0.01) is None and len(wire.written) == 1
    found = cycles.overruled(wire.now() + 0.01)
    assert found is not None and found.place == 1 and len(wire.written) == 2


def test_nothing_is_read_back_before_the_first_goals_or_without_being_prepared() -> None:
    wire = Wire()
    assert read_back_of(wire).overruled(1.0) is None
    plain = exchange(wire)
    plain.cycle([0, 0])
    wire.written.clear()
    assert plain.overruled(wire.now() + 1.0) is None and plain.read_torque() is None
    assert not wire.written


@pytest.mark.parametrize("is_late", [False, True])
def test_torque_is_read_outside_a_cycle_unless_a_late_reply_may_be_on_its_way(is_late: bool) -> None:
    wire = Wire()
    cycles = ready(wire)
    if is_late:
        cycles.cycle([0, 0])  # no reply
    wire.written.clear()
    assert cycles.read_torque() is None
    assert bool(wire.written) is not is_late
    cycles.cycle([0, 0])
    wire.written.clear()
    cycles.cycle([0, 0])
    assert cycles._late_possible, "neither cycle was answered"
    longer = [encode_status(servo, 0, bytes(bytes_asked(wire)[-1] + 1)) for servo in (1, 2)]
    wire.answers = [b"".join(longer)]
    assert None not in cycles.cycle([0, 0]).servos
    wire.written.clear()
    cycles.read_torque()
    assert wire.written, "the latest reply was in time"


def test_a_stall_during_a_read_back_does_not_prevent_the_next_one() -> None:
    wire = Wire()
    cycles = ready(wire)
    back = cycles._read_back
    assert back is not None
    reply = b"".join(encode_status(servo, 0, bytes(back.read.reply_size // 2 - 11)) for servo in (1, 2))
    wire.answers, read = [reply], wire.read

    def stalled(count: int, timeout: float) -> bytes:
        wire.time += 0.05
        return read(count, timeout)

    wire.read = stalled  # type: ignore[method-assign]
    cycles.overruled(wire.now() + 0.01)
    wire.read = read  # type: ignore[method-assign]
    wire.written.clear()
    cycles.overruled(wire.now() + 0.002)
    assert wire.written, "it is expected to take up to twice as long as one should"


def test_a_stuffed_reply_leaves_time_for_a_read_back() -> None:
    wire = Wire()
    cycles = ready(wire)
    wire.time = 100.0
    wire.answers = [answer(1, -1, 0xFD, 7) + answer(2, 1, 2, 3)]
    assert cycles.cycle([0, 0]).servos[0] == (0, -1, 0xFD, 7)
    wire.written.clear()
    cycles.overruled(wire.now() + 0.003)
    assert wire.written
