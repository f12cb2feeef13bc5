"""Which cycles read the slow registers, how long a second reply is awaited, and what counts as a stranger's."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.drivers.exchange import Exchange
from hil.drivers.others.read_back import TRY_AGAIN_S
from hil.drivers.packet import Framer, encode_status
from hil.drivers.servo_model import Mode
from hil.drivers.state import spans, status_span
from hil.drivers.turns import Turns
from tests.drivers.test_exchange import XM430, Wire, answer, asked, exchange
from tests.drivers.test_read_back_exchange import read_back_of

FINE = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)


def test_plain_sync_reads_are_the_default() -> None:
    assert not Exchange(Wire(), [1], XM430["Goal Current"], spans(Mode.CURRENT, [XM430]), 0.0).fast


def test_unless_told_otherwise_slow_registers_are_read_every_100_cycles_and_the_status_every_20() -> None:
    tables = [XM430, XM430]
    usual, status = spans(Mode.CURRENT, tables), status_span(Mode.CURRENT, tables, whole=True)
    cycles = Exchange(Wire(), (1, 2), XM430["Goal Current"], usual, 0.0, status=status)
    read = []
    for _ in range(101):
        read.append(cycles.cycle([0, 0]).span)
        cycles._late_possible = False
    assert [number for number, span in enumerate(read, 1) if span == len(usual)][:2] == [20, 40]
    assert [number for number, span in enumerate(read, 1) if span == 1] == [100]


@pytest.mark.parametrize(("interval", "patience"), [(None, 0.0), (0.002, 0.0), (0.02, 0.01), (0.1, 0.02)])
def test_replies_are_awaited_for_half_of_a_cycle_and_at_most_20_ms_if_that_is_longer_than_they_need(
    interval: float | None, patience: float
) -> None:
    """In addition to the time on the wire, they need 1 ms for the adapter and 0.75 ms for the computer."""
    wire = Wire()
    given: dict[str, Any] = {} if interval is None else {"interval": interval}
    usual = spans(Mode.CURRENT, [XM430, XM430])[:1]
    cycles = Exchange(wire, (1, 2), XM430["Goal Current"], usual, 0.0, **given)
    cycles.cycle([0, 0])
    needed = wire.wire_time(len(wire.written[0]) + 2 * (21 + 2)) + 1e-3 + 0.75e-3
    assert wire.time == pytest.approx(max(needed, patience))


def test_between_two_samples_the_slow_registers_are_never_read() -> None:
    wire = Wire([FINE] * 50)
    cycles = exchange(wire)
    for _ in range(9):
        assert cycles.cycle([0, 0]).span == 0
    assert [cycles.cycle([0, 0], between=True).span for _ in range(30)] == [0] * 30
    assert cycles.cycle([0, 0]).span == 1, "which were due all the time"


def test_the_status_is_read_when_it_is_due_and_the_slow_registers_when_they_are() -> None:
    tables = [XM430, XM430]
    usual, status = spans(Mode.CURRENT, tables), status_span(Mode.CURRENT, tables, whole=True)
    cycles = Exchange(Wire(), (1, 2), XM430["Goal Current"], usual, 0.0, slow_every=7, status=status, status_every=3)
    read = []
    for _ in range(8):
        read.append(cycles.cycle([0, 0]).span)
        cycles._late_possible = False
    assert read == [0, 0, len(usual), 0, 0, len(usual), 1, 0]


def test_a_read_back_for_which_this_program_wakes_up_too_late_is_tried_again_after_a_pause() -> None:
    wire = Wire([FINE])
    cycles = read_back_of(wire)
    cycles.cycle([0, 0])
    due = wire.now() + 0.1
    wire.wait_until = lambda _: setattr(wire, "time", due)  # type: ignore[method-assign]
    assert cycles.overruled(due) is None and len(wire.written) == 1
    assert cycles.read_back_at == pytest.approx(due + TRY_AGAIN_S, abs=1e-9)


def test_a_reply_behind_one_that_came_too_soon_is_awaited_until_the_usual_timeout() -> None:
    class Paced(Wire):
        """The second reply arrives after a tenth of a millisecond."""

        def read(self, count: int, timeout: float) -> bytes:
            if self.time > 1.0 and timeout < 1e-4:
                return b""
            return super().read(count, timeout)

    former, present = FINE, answer(1, 7, 8, 9) + answer(2, 7, 8, 9)
    wire = Paced([former + present])
    wire.time = 1.0
    assert exchange(wire).cycle([0, 0]).servos[0] == (0, 7, 8, 9)


@pytest.mark.parametrize(("data", "strangers"), [(b"", 0), (b"\1", 1), (b"\1\2", 1)])
def test_a_reply_with_data_that_this_program_did_not_ask_for_is_a_strangers(data: bytes, strangers: int) -> None:
    wire = Wire([encode_status(9, 0, data) + FINE[:20]])
    cycles = exchange(wire)
    cycles.cycle([0, 0])
    assert cycles.heard.strangers == strangers


@pytest.mark.parametrize("at", [9, 30])
def test_of_a_damaged_reply_behind_one_that_came_too_soon_the_intact_part_is_used(at: int) -> None:
    present = bytearray(answer(1, 7, 8, 9) + answer(2, 7, 8, 9))
    present[at] ^= 0x40
    wire = Wire([FINE + bytes(present)])
    wire.time = 1.0
    fresh = (0, 7, 8, 9)
    assert exchange(wire).cycle([0, 0]).servos == ([None, fresh] if at < 21 else [fresh, None])


def test_a_second_reply_is_awaited_no_longer_than_any() -> None:
    wire = Wire([FINE])
    wire.time = 1.0
    cycles = exchange(wire)
    assert cycles.cycle([0, 0]).servos[0] == (0, 1, 2, 3)
    assert 1.0 < wire.time <= 1.0 + cycles.patience + 1e-9


@pytest.mark.parametrize("ids", [(1, 2), (1, 2, 3, 4, 5)])
def test_the_longest_exchange_is_all_that_is_sent_and_received(ids: tuple[int, ...]) -> None:
    wire = Wire()
    tables = [XM430] * len(ids)
    usual = spans(Mode.CURRENT, tables)[:1]
    cycles = Exchange(wire, ids, [XM430["Goal Current"], *[XM430["Goal PWM"]] * (len(ids) - 1)], usual, 0.0)
    cycles.cycle([0] * len(ids))
    assert cycles.longest == pytest.approx(wire.wire_time(len(wire.written[0]) + 21 * len(ids)))


@given(
    slow_every=st.integers(1, 9),
    status_every=st.integers(1, 9),
    cycles=st.lists(st.sampled_from(["sample", "between", "lost", "asked"]), max_size=60),
)
def test_spans_are_due_as_if_every_cycle_counted_down_to_each_of_them(
    slow_every: int, status_every: int, cycles: list[str]
) -> None:
    turns, until_slow, until_status, slow = Turns(2, slow_every, status_every), slow_every, status_every, 0
    left = turns.plan()
    for cycle in cycles:
        if cycle == "asked":
            turns.count(left)
            turns.read_status_next()
            left, until_status = turns.plan(), min(until_status, 1)
        if cycle == "lost":
            turns.count(left)
            left = turns.usual = 0
        between = cycle == "between"
        turns.between += between
        left -= 1
        if left < 0:
            turns.count(left)
            read = turns.due(between)
            left = turns.plan()
        else:
            read = 0
        until_slow, until_status = until_slow - (not between), until_status - 1
        if until_slow <= 0 and not between:
            until_slow, slow = slow_every, slow % 2 + 1
            assert read == slow
        elif until_status <= 0:
            until_status = status_every
            assert read == 3
        else:
            assert read == 0


class Echoing(Wire):
    """An adapter that echoes what is sent; of the first reply, it delivers as much as makes a reply with the echo."""

    echoes = True

    def write(self, data: bytes) -> None:
        self.written.append(data)
        size = list(Framer().feed(data))[-1].body[2]
        reply = encode_status(1, 0, bytes(size)) + encode_status(2, 0, bytes(size))
        self.waiting += data + (reply if len(self.written) > 1 else reply[: len(reply) - len(data)])


def test_an_echo_and_a_part_of_a_reply_that_are_as_long_as_a_reply_do_not_show_that_echoes_have_ended() -> None:
    cycles = exchange(Echoing())
    assert cycles.cycle([7, 8]).servos == [None, None]
    for _ in range(3):
        assert cycles.cycle([7, 8]).servos == [(0, 0, 0, 0)] * 2
    assert cycles.heard.strangers == 0, "its own packets are not another program's"


def test_from_a_certain_cycle_on_replies_may_be_awaited_longer() -> None:
    wire = Wire([b""])
    cycles = exchange(wire)
    before = cycles.patience
    cycles.wait_longer(0.005)
    assert cycles.patience == pytest.approx(before + 0.005)
    cycles.cycle([0, 0])
    assert asked(wire) == [10] and before < wire.time <= cycles.patience and wire.time > 0.005
