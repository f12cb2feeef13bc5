"""dynamixel_sdk in random order against rules from the manual: the same answers, and the comparison is sharp."""

from dataclasses import replace

import pytest

from benchmarks.bus import random_calls
from benchmarks.bus.servo_rules import XM430_W350, Rules

CALLS = 60


def test_a_servo_answers_as_the_manual_says() -> None:
    found, calls, _ = random_calls.differences(CALLS, seed=3)
    assert found == []
    assert len(calls) >= 12 and sum(calls.values()) > 3 * CALLS


def test_a_servo_that_holds_something_else_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    other = tuple(replace(row, initial=15) if row.address == 24 else row for row in XM430_W350)
    monkeypatch.setitem(random_calls.TABLES, "XM430-W350", other)
    monkeypatch.setattr(Rules, "learn", lambda *_: None)

    def factory_reset(client: random_calls.Client) -> None:
        client.handler.factoryReset(client.port, 1, 2)
        random_calls.time.sleep(random_calls.BOOT_S)
        client.servos[1].factory_reset(())

    monkeypatch.setattr(random_calls.Client, "step", factory_reset)
    found, _, _ = random_calls.differences(1, seed=3)
    assert found == []  # nothing has been compared since
    monkeypatch.setattr(random_calls, "WHOLE_EVERY", 1)
    found, _, _ = random_calls.differences(1, seed=3)
    assert any("read 1 24, expected 15" in each for each in found)


@pytest.mark.parametrize(
    ("address", "data", "torque", "wanted"),
    [
        (84, b"\x00\x40", 0, {4}),
        (84, b"\x00", 0, {5}),
        (132, b"\x00\x00\x00\x00", 0, {7}),
        (36, b"\x00\x01", 1, {7}),
        (36, b"\x00\x01", 0, {0}),
        (11, b"\x02", 0, {4}),
        (3, b"\x00", 0, {5, 7}),
    ],
)
def test_rules(address: int, data: bytes, torque: int, wanted: set[int]) -> None:
    assert Rules(XM430_W350, {64: torque}).write(address, data) == wanted
