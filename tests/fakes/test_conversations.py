"""Random conversations over the protocol's own bytes with every X model: the answers are those that the manual allows,
and the comparison is strict.

`benchmarks/bus/conversations.py` holds thousands.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.bus import codec
from benchmarks.bus.codec import Status, Wrong, packet
from benchmarks.bus.conversation.groups import Conversation
from benchmarks.bus.conversation.servos import NUMBERS
from benchmarks.bus.conversations import converse
from benchmarks.bus.servo_rules import TABLES, Row
from hil.fakes.servo.registers import MODEL_NAMES
from hil.fakes.servo.servo import EmulatedServo


@settings(max_examples=40)
@given(seed=st.integers(0, 1 << 32), models=st.lists(st.sampled_from(MODEL_NAMES), min_size=1, max_size=4))
def test_servos_answer_as_the_manual_says(seed: int, models: list[str]) -> None:
    assert converse(seed, models).differences == []


def test_the_manuals_tables_cover_every_model() -> None:
    assert set(TABLES) == set(NUMBERS) == set(MODEL_NAMES)


def differences(conversations_held: int) -> list[str]:
    return [each for seed in range(conversations_held) for each in converse(seed, ["XM540-W150"]).differences]


def test_a_register_that_differs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    wider = tuple(Row(44, 4, 0, 9000, 230) if row.address == 44 else row for row in TABLES["XM540-W150"])
    monkeypatch.setitem(TABLES, "XM540-W150", wider)
    talk = Conversation(1, ["XM540-W150"])
    talk._write(talk.servos[0], 44, b"\x00\x04\x00\x00")
    assert len(talk.differences) == 1 and "write 44 00 04 00 00, allowed [{0}]" in talk.differences[0]


def test_another_model_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NUMBERS, "XM540-W150", 1120)
    assert differences(5)


def test_an_answer_with_another_return_delay_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    derive = EmulatedServo._derive

    def late(servo: EmulatedServo) -> None:
        derive(servo)
        servo.return_delay_s += 60e-6

    monkeypatch.setattr(EmulatedServo, "_derive", late)
    assert any("Return Delay Time" in each for each in differences(30))


def test_the_manuals_packets() -> None:
    """Examples of page protocol2, among them the status of a Read."""
    assert packet(1, codec.PING) == bytes.fromhex("FFFFFD00 01 0300 01 194E")
    assert packet(1, codec.CLEAR, b"\x01\x44\x58\x4c\x22") == bytes.fromhex("FFFFFD00 01 0800 10 0144584C22 B1DC")
    answer = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
    assert codec.statuses(answer) == [Status(1, 0, b"\xa6\0\0\0")]
    for wrong in (answer[:-1], answer[1:], answer + b"\0", answer[:9] + b"\xa7" + answer[10:]):
        with pytest.raises(Wrong):
            codec.statuses(wrong)


def test_what_looks_like_a_header_is_stuffed() -> None:
    content = b"\xff\xff\xfd\x01\xff\xff\xfd"
    assert codec.stuffed(content) == b"\xff\xff\xfd\xfd\x01\xff\xff\xfd\xfd"
    talk = Conversation(1, ["XM430-W350"])
    for _ in range(50):
        talk.stuffing()
    assert talk.differences == []
