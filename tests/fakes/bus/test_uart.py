"""Bytes received at a baud rate other than the sender's."""

import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.drivers.packet import Framer, Instruction, encode
from hil.fakes.bus.uart import heard, overlaid

RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)


@given(st.binary(max_size=40), st.sampled_from(RATES))
def test_the_same_baud_hears_what_was_sent(data: bytes, baud: int) -> None:
    received = heard(data, baud, baud)
    assert bytes(byte for byte, _ in received) == data
    assert [at for _, at in received] == pytest.approx([10 * (index + 1) / baud for index in range(len(data))])


@given(st.binary(min_size=1, max_size=40), st.sampled_from([0.98, 1.02]))
def test_two_per_cent_off_is_still_understood(data: bytes, off: float) -> None:
    assert bytes(byte for byte, _ in heard(data, 1_000_000, round(off * 1_000_000))) == data


def test_a_faster_receiver_hears_one_byte_in_many_pieces() -> None:
    # 0x00 at 9600 is low for 9 bits: at 115200 that is 108 bits of break, received as zeros with broken stop bits.
    assert {byte for byte, _ in heard(b"\x00", 9_600, 115_200)} <= {0x00}
    assert heard(b"\xff", 9_600, 115_200)[0][0] == 0x00  # the start bit alone lasts for a byte


@given(st.binary(max_size=60), st.sampled_from(RATES), st.sampled_from(RATES))
def test_what_is_heard_is_over_with_the_line(data: bytes, sent: int, at: int) -> None:
    received = heard(data, sent, at)
    assert all(later > earlier for (_, earlier), (_, later) in itertools.pairwise(received))
    assert len(received) <= max(1, 10 * len(data) * at / sent)


def test_a_reply_on_its_way_is_garbage_to_a_host_that_changes_its_baud(bench: Any) -> None:
    bench.bus.write(encode(1, Instruction.PING))
    bench.wait(15 * 10e-6)  # five bytes of the reply are there
    bench.bus.baud = 115_200
    raw = bench.bus.read(100, 0.01)
    assert raw[:5] == b"\xff\xff\xfd\x00\x01"
    assert raw[5:]
    assert list(Framer().feed(raw)) == []


def test_the_baud_asked_for_is_set_behind_the_status_at_the_old_one(bench: Any) -> None:
    """As in every set-up, the reply is not lost, since the host reads it before it changes its baud rate."""
    assert bench.write(1, 8, 2) == 0
    bench.bus.baud = 115_200
    assert bench.ask(1, Instruction.PING).error == 0


def test_what_overlaps_is_one_piece_and_a_low_bit_wins() -> None:
    assert overlaid([(0, b"\x0f\xff"), (20, b"\x01"), (0, b"\x3c")]) == [(0, b"\x0c\xff"), (20, b"\x01")]
    assert overlaid([(0, b"\xff"), (5, b"\xff")]) == [(0, b"\xef")]  # the second start bit falls into the data
