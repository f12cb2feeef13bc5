"""How often servos are asked at low sample rates, and which registers their status includes."""

from types import SimpleNamespace
from typing import Any

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.exchange import HOST_S
from hil.drivers.joint import Joint
from hil.drivers.packet import BROADCAST_ID, Instruction, encode
from hil.drivers.preparation.cadence import CHECK_S, STATUS_S, cadence, exchange_interval
from hil.drivers.servo_model import Mode, servo_model
from hil.drivers.state import status_span
from hil.drivers.sync_read import SyncRead, one_each

XM540, XC330 = "XM540-W270", "XC330-T288"
BAUD = 1_000_000


def cadence_of(
    servos: int, rate: float, baud: int = BAUD, model: str = XM540, return_delay: float = 0.0
) -> tuple[int, bool | None, int]:
    """Exchanges per sample, whether the status includes Torque Enable (None without status), exchanges per status."""
    port: Any = SimpleNamespace(wire_time=lambda count: 10 * count / baud)
    table = load_control_table(model)
    drives = [Joint(f"j{number}", number, servo_model(model)) for number in range(1, servos + 1)]
    every, span, seldom = cadence(1 / rate, port, drives, [table] * servos, return_delay)
    return every, None if span is None else table["Torque Enable"].address >= one_each(span, servos)[0].address, seldom


def wire_s(servos: int, model: str, *, whole: bool) -> float:
    """Time that the packets of an exchange with status take on the wire [s]."""
    table, mode = load_control_table(model), Joint("j", 1, servo_model(model)).mode
    read = SyncRead(list(range(1, servos + 1)), status_span(mode, [table] * servos, whole=whole))
    goals = encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes(4 + 3 * servos))
    return 10 * (len(goals) + len(read.request) + read.reply_size) / BAUD


@pytest.mark.parametrize("rate", [20.0, 33.0, 40.0, 51.0, 60.0, 75.0, 99.0, 100.0, 101.0, 400.0])
def test_exchanges_are_at_most_10_ms_apart(rate: float) -> None:
    """Beyond 100 Hz, one exchange per sample is enough, below it as few as possible are used."""
    every, _, seldom = cadence_of(2, rate)
    assert 1 / rate / every <= CHECK_S * 1.001
    assert every == 1 or 1 / rate / (every - 1) > CHECK_S
    assert exchange_interval(1 / rate) == pytest.approx(1 / rate / every)
    assert abs(seldom / rate / every - STATUS_S) <= 0.5 / rate / every


@pytest.mark.parametrize(
    ("servos", "rate", "expected"),
    [
        (8, 60.0, (2, False)),  # Torque Enable would leave room for one exchange per sample only
        (8, 20.0, (5, False)),
        (4, 60.0, (2, True)),
        (8, 80.0, (1, True)),  # no room for two exchanges per sample anyway
        (16, 60.0, (1, False)),
        (20, 60.0, (1, None)),
    ],
)
def test_frequent_exchanges_come_before_reading_torque_enable(
    servos: int, rate: float, expected: tuple[int, bool | None]
) -> None:
    assert cadence_of(servos, rate)[:2] == expected


@pytest.mark.parametrize("servos", [1, 3])
@pytest.mark.parametrize(("model", "share"), [(XM540, 0.6), (XC330, 0.9)])
@pytest.mark.parametrize("return_delay", [0.0, 2e-4])
def test_a_status_is_read_if_the_wire_leaves_time(servos: int, model: str, share: float, return_delay: float) -> None:
    """Reading a supply-sensing servo's Torque Enable is worth a later sample."""
    for whole in (True, False):
        least = (wire_s(servos, model, whole=whole) + return_delay * servos) / share
        fits, not_quite = (
            cadence_of(servos, 1 / sample, model=model, return_delay=return_delay)
            for sample in (1.001 * least, 0.999 * least)
        )
        assert fits[:2] == (1, whole) and not_quite[:2] == (1, False if whole else None)


def test_exchanges_leave_this_computer_time() -> None:
    servos = 8
    least = wire_s(servos, XM540, whole=False) / 0.6 + HOST_S
    assert CHECK_S < 2 * least < 2 * CHECK_S
    assert cadence_of(servos, 0.5 / (1.001 * least))[:2] == (2, False)
    assert cadence_of(servos, 0.5 / (0.999 * least))[:2] == (1, True)


def test_goals_of_two_kinds_take_two_packets() -> None:
    port: Any = SimpleNamespace(wire_time=lambda count: 10 * count / BAUD)
    both = [Joint("a", 1, servo_model(XM540)), Joint("b", 2, servo_model(XM540), mode=Mode.PWM)]
    table = load_control_table(XM540)
    spans = status_span([each.mode for each in both], [table] * 2, whole=False)
    sizes = [encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes(4 + 3)) for _ in both]
    read = SyncRead([1, 2], spans)
    least = 10 * (sum(map(len, sizes)) + len(read.request) + read.reply_size) / BAUD / 0.6
    assert cadence(1.001 * least, port, both, [table] * 2, 0.0)[1] is not None
    assert cadence(0.999 * least, port, both, [table] * 2, 0.0)[1] is None


def test_a_slow_bus_allows_fewer_exchanges() -> None:
    assert cadence_of(2, 20.0)[0] == 5
    assert cadence_of(2, 20.0, baud=57_600)[0] == 1
    assert cadence_of(20, 60.0) == (1, None, 0)


def test_without_a_known_rate_there_is_one_exchange_and_no_status() -> None:
    port: Any = SimpleNamespace(wire_time=lambda count: 10 * count / BAUD)
    assert cadence(0.0, port, [Joint("j", 1, servo_model(XM540))], [load_control_table(XM540)], 0.0) == (1, None, 0)
