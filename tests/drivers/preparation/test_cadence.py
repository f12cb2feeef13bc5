"""How often servos are asked at low sample rates."""

from types import SimpleNamespace
from typing import Any

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.joint import Joint
from hil.drivers.preparation.cadence import CHECK_S, cadence, exchange_interval
from hil.drivers.servo_model import servo_model
from hil.drivers.sync_read import one_each

MODEL = "XM540-W270"
BAUD = 1_000_000


def cadence_of(servos: int, rate: float, baud: int = BAUD) -> tuple[int, bool | None]:
    """Exchanges per sample, and whether the status includes Torque Enable; None without status."""
    port: Any = SimpleNamespace(wire_time=lambda count: 10 * count / baud)
    table = load_control_table(MODEL)
    drives = [Joint(f"j{number}", number, servo_model(MODEL)) for number in range(1, servos + 1)]
    every, span, _ = cadence(1 / rate, port, drives, [table] * servos, 0.0)
    return every, None if span is None else table["Torque Enable"].address >= one_each(span, servos)[0].address


@pytest.mark.parametrize("rate", [20.0, 33.0, 40.0, 51.0, 60.0, 75.0, 99.0, 100.0, 101.0, 400.0])
def test_exchanges_are_at_most_10_ms_apart(rate: float) -> None:
    """Beyond 100 Hz, one exchange per sample is enough, below it as few as possible are used."""
    every, _ = cadence_of(2, rate)
    assert 1 / rate / every <= CHECK_S * 1.001
    assert every == 1 or 1 / rate / (every - 1) > CHECK_S
    assert exchange_interval(1 / rate) == pytest.approx(1 / rate / every)


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
    assert cadence_of(servos, rate) == expected


def test_a_slow_bus_allows_fewer_exchanges() -> None:
    assert cadence_of(2, 20.0)[0] == 5
    assert cadence_of(2, 20.0, baud=57_600)[0] == 1
