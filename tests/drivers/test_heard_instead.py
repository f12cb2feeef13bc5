"""What is said of bytes that arrived instead of complete replies: damaged, late, or intact under another ID."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.packet import Instruction, encode, encode_status
from tests.drivers.test_exchange import Wire, answer, exchange, fast_answer, state

FINE = answer(1, 1, 2, 3) + answer(2, 4, 5, 6)


def said(*received: bytes, fast: bool = False, waiting: bytes = b"", later_s: float = 0.0) -> str:
    """What `heard_instead` says after cycles in which these bytes were received."""
    wire = Wire(received)
    cycles = exchange(wire, fast=fast)
    for _ in received:
        cycles.cycle([0, 0])
        wire.waiting = waiting
    if waiting:
        cycles.cycle([0, 0])
    wire.time += later_s
    bus: Any = SimpleNamespace(prepared=cycles, port=wire)
    return str(cast(Any, ServoBus.heard_instead).fget(bus))


def both(first: int, second: int, *, fast: bool) -> bytes:
    if fast:
        return fast_answer((first, 0, state(1, 2, 3)), (second, 0, state(4, 5, 6)))
    return answer(first, 1, 2, 3) + answer(second, 4, 5, 6)


@pytest.mark.parametrize("fast", [False, True])
def test_intact_replies_with_an_id_that_was_not_asked_are_not_called_damaged(fast: bool) -> None:
    assert said(both(7, 2, fast=fast), fast=fast).startswith("Intact replies came from ID 7, which was not addressed")


@pytest.mark.parametrize("fast", [False, True])
def test_nor_are_two_replies_with_the_same_id(fast: bool) -> None:
    assert said(both(2, 2, fast=fast), fast=fast).startswith("Intact replies came from IDs 2, 2, although")


def test_or_the_same_servos_in_another_order() -> None:
    assert said(both(2, 1, fast=False)).startswith("Intact replies came from IDs 2, 1, although each servo was asked")
    twice = answer(1, 1, 2, 3) + answer(1, 1, 2, 3) + b"noise"
    assert said(twice).startswith("Intact replies came from IDs 1, 1, although each servo was asked once")


@pytest.mark.parametrize(("count", "stops"), [(2, False), (3, True)])
@pytest.mark.parametrize(
    ("kind", "message"), [("strangers", "has sent or requested 3 packets"), ("mixed_up", "Intact")]
)
def test_two_foreign_packets_or_replies_under_other_ids_are_borne_and_three_are_not(
    fake_config: Callable[..., BusConfig], kind: str, message: str, count: int, stops: bool
) -> None:
    """A late reply can look like one."""
    with ServoBus.open(fake_config()) as bus:
        setattr(bus.prepared.heard, kind, count)
        if not stops:
            bus.exchange([0.0, 0.0])
            return
        with pytest.raises(DriverError, match=message):
            bus.exchange([0.0, 0.0])


@pytest.mark.parametrize("data_bytes", [16, 21])
def test_another_masters_instruction_as_long_as_a_reply_is_no_late_reply(data_bytes: int) -> None:
    """The slow registers, which are read now and then, have 16 and 21 bytes."""
    written = encode(1, Instruction.WRITE, bytes(data_bytes + 1))
    assert not said(written).startswith("Replies did arrive, but too late")
    assert said(encode_status(1, 0, bytes(data_bytes))[:-1]).startswith("Replies did arrive, but too late")


def test_an_instruction_that_breaks_off_behind_noise_is_another_masters() -> None:
    cycles = exchange(Wire((b"\x55" * 15 + encode(2, Instruction.WRITE, b"\x66\x00\x10\x00")[:12] + FINE,)))
    assert cycles.cycle([0, 0]).servos == [(0, 1, 2, 3), (0, 4, 5, 6)]
    assert cycles.heard.strangers == 1


@pytest.mark.parametrize("kept", [4, 7, 8, 10])
def test_a_refusal_that_breaks_off_is_no_instruction_of_another_master(kept: int) -> None:
    cycles = exchange(Wire((encode_status(1, 7)[:kept] + answer(2, 4, 5, 6),)))
    assert cycles.cycle([0, 0]).servos == [None, (0, 4, 5, 6)]
    assert cycles.heard.strangers == 0


@pytest.mark.parametrize(("ids", "fast"), [((2, 2), False), ((1, 1), False), ((2, 1), False), ((2, 2), True)])
def test_a_reading_under_another_servos_id_is_no_reading(ids: tuple[int, int], fast: bool) -> None:
    fine, wrong = both(1, 2, fast=fast), both(*ids, fast=fast)
    cycles = exchange(Wire((fine, wrong)), fast=fast)
    assert None not in cycles.cycle([0, 0]).servos and cycles.heard.mixed_up == 0
    assert cycles.cycle([0, 0]).servos == [None, None]
    assert cycles.heard.mixed_up == 1
    assert cycles.heard.mixed_up_advice("here").startswith(f"Intact replies came from IDs {ids[0]}, {ids[1]}, ")


def test_replies_out_of_order_because_they_are_late_are_not_taken_for_mixed_up_ones() -> None:
    wire = Wire((answer(2, 4, 5, 6) + answer(1, 1, 2, 3),))
    cycles = exchange(wire)
    assert cycles.cycle([0, 0]).servos == [None, None] and cycles.heard.mixed_up == 1
    wire.waiting = answer(2, 4, 5, 6)
    cycles.cycle([0, 0])
    assert cycles.heard.mixed_up == 0


@pytest.mark.parametrize("fast", [False, True])
def test_damaged_ones_are(fast: bool) -> None:
    fine = both(1, 2, fast=fast)
    assert said(fine[:-3] + b"abc", fast=fast).startswith("Bytes arrived, but damaged or incomplete: ")
    assert said(fine[:9] + b"a" + fine[10:], fast=fast).startswith("Bytes arrived, but damaged or incomplete: ")


def test_nothing_is_said_of_silence_or_of_what_was_long_ago() -> None:
    assert said(b"") == said(FINE) == said(answer(1, 1, 2, 3)) == ""
    assert said(12 * b"\x55" + FINE) == "", "every servo has answered"
    assert said(FINE[:-3] + b"abc", later_s=0.11) == said(both(7, 2, fast=False), later_s=0.11) == ""
    assert said(FINE[:-3] + b"abc", later_s=0.09) and said(both(7, 2, fast=False), later_s=0.09)


def test_late_replies_are_called_late() -> None:
    assert said(b"", waiting=FINE).startswith("Replies did arrive, but too late or twice")


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("kept", [0, 15, -5, -3])
def test_a_reply_or_its_end_that_arrives_again_is_called_repeated(kept: int, fast: bool) -> None:
    """With a fast read, only the last servo's part may be repeated, which has no header."""
    fine = both(1, 2, fast=fast)
    repeated = said(fine, waiting=fine[kept:], fast=fast).startswith("Replies are repeated in transit")
    assert repeated == (kept != -3), "three bytes may be noise"


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("kept", [-1, -5])
def test_a_reply_that_was_still_arriving_when_time_was_up_is_late_not_damaged(kept: int, fast: bool) -> None:
    fine = both(1, 2, fast=fast)
    late = "Replies did arrive, but too late or twice"
    assert said(fine[:kept], waiting=fine[kept:], fast=fast).startswith(late), "its rest waits before the next request"
    assert said(fine[:kept], fine[kept:], fast=fast).startswith(late), "its rest comes after the next request"
    longer = [(servo, 0, b"\x00" + state(1, 2, 3)) for servo in (1, 2)]
    following = fast_answer(*longer) if fast else b"".join(encode_status(*each) for each in longer)
    assert said(fine[:kept], following[:kept], fast=fast).startswith("Bytes arrived, but damaged or incomplete")


@pytest.mark.parametrize("fast", [False, True])
def test_so_is_the_beginning_of_a_reply_to_an_earlier_request(fast: bool) -> None:
    """After a lost reply another number of bytes is asked for; stuffing does not count."""
    stuffed = encode_status(1, 0, b"\xff\xff\xfd" + state(1, 2, 3)[3:])
    for noise in (b"", 10 * b"\x55"):
        assert said(b"", noise + stuffed[:-1]).startswith("Replies did arrive, but too late or twice")
    assert said(b"", both(1, 2, fast=fast)[:-1], fast=fast).startswith("Replies did arrive, but too late or twice")


def test_a_lost_reply_after_stuffed_ones_is_not_called_late() -> None:
    """Stuffing makes a reply as long as one to another request."""
    stuffed = encode_status(1, 0, b"\xff\xff\xfd" + state(1, 2, 3)[3:]) + answer(2, 4, 5, 6)
    assert b"\xff\xff\xfd\xfd" in stuffed
    assert said(stuffed, b"") == ""
