"""dynamixel_sdk calls in random order compared with rules from the manual: the answers are the same, and the comparison
is strict.

In virtual time; `benchmarks/bus/random_calls.py` does the same over a terminal.
"""

import pytest

from benchmarks.bus import random_calls
from benchmarks.bus.random_calls import Client, call, servos
from benchmarks.bus.servo_rules import XM430_W350, Row, Rules
from hil.drivers.port import Port
from hil.drivers.sdk_port import SdkPort
from hil.fakes.protocol_fake import open_fake

CALLS = 400


def client(seed: int) -> Client:
    serial = open_fake(servos())
    clock = serial.clock
    return Client(SdkPort(Port("fake://", 1_000_000, serial)), seed, lambda s: clock.wait_until(clock.now() + s))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_servo_answers_as_the_manual_says(seed: int) -> None:
    asking = client(seed)
    call(asking, CALLS)
    assert asking.differences == []
    assert len(asking.calls) >= 16 and sum(asking.calls.values()) > 3 * CALLS


def changed(address: int, row: Row) -> tuple[Row, ...]:
    return tuple(row if each.address == address else each for each in XM430_W350)


@pytest.mark.parametrize(
    ("address", "row", "named"),
    [
        (24, Row(24, 4, 0, 5000, 10), "expected {0}"),  # a wider range
        (84, Row(84, 4, 0, 16383), "(2, 0"),  # longer
    ],
)
def test_a_servo_that_differs_is_found(address: int, row: Row, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(random_calls.TABLES, "XM430-W350", changed(address, row))
    asking = client(3)
    for _ in range(4):
        call(asking, CALLS)
        if about := [each for each in asking.differences if f" {address}" in each]:
            break
    assert about and (named.startswith("(") or any(named in each for each in about))


@pytest.mark.parametrize(
    ("address", "data", "torque", "wanted"),
    [
        (84, b"\x00\x40", 0, {4}),
        (84, b"\x00", 0, {5}),
        (132, b"\x00\x00\x00\x00", 0, {7}),
        (36, b"\x00\x01", 1, {7}),
        (36, b"\x00\x01", 0, {0}),
        (11, b"\x02", 0, {4}),
        (3, b"\x00", 0, {7}),
    ],
)
def test_rules(address: int, data: bytes, torque: int, wanted: set[int]) -> None:
    assert Rules(XM430_W350, {64: torque}).write(address, data) == wanted


def test_switching_the_mode_resets_the_profile() -> None:
    rules = Rules(XM430_W350, {11: 3, 36: 885, 38: 1193, 108: 5, 112: 7, 84: 900})
    rules.write(11, b"\x00")
    assert [rules.expected(each) for each in (11, 84, 100, 102, 108, 112)] == [0, None, 885, 1193, 0, 0]
