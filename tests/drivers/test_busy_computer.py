"""A busy computer delays replies for some milliseconds at a time; that is not the adapter, nor a damaged reply."""

import math
from types import SimpleNamespace
from typing import cast

import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS

from hil.drivers.errors import WrongReply
from hil.drivers.preparation.prepare import learn_latency
from hil.drivers.servo import Servo
from hil.fakes.bus.clock import VirtualClock


class Pinged:
    """A servo whose replies take `slow` [s] until `until` [s], and 0.3 ms later on."""

    def __init__(self, slow: float, until: float) -> None:
        self.clock = VirtualClock()
        self.port = SimpleNamespace(clock=self.clock, latency=1e-3, latency_measured=False, wire_time=lambda _: 2.4e-4)
        self._slow, self._until = slow, until

    def ping(self, attempts: int) -> int:
        now = self.clock.now()
        self.clock.wait_until(now + (self._slow if now < self._until else 3e-4))
        return attempts


@pytest.mark.parametrize(("until", "is_slow"), [(0.0, False), (0.2, False), (math.inf, True)])
def test_only_an_adapter_that_is_always_slow_is_slow(until: float, is_slow: bool) -> None:
    servo = Pinged(4e-3, until)
    learn_latency(cast("Servo", servo))
    assert servo.port.latency_measured == is_slow
    assert (servo.port.latency > 2e-3) == is_slow
    assert servo.clock.now() < 1.0


def attempts_of(results: list[int]) -> tuple[list[float], str]:
    """When attempts at a read with these results are made [s], and the message if all fail."""
    clock, times = VirtualClock(), []
    servo = Servo.__new__(Servo)
    servo.id, servo.title = 1, "The servo"
    servo.port = SimpleNamespace(clock=clock, discard_input=lambda: None)  # type: ignore[assignment]
    servo._sdk = SimpleNamespace(getTxRxResult=lambda _: "[TxRxResult] Incorrect status packet!")

    def action() -> tuple[int, int, int]:
        times.append(clock.now())
        return 7, results[len(times) - 1], 0

    try:
        servo._try("reading", action, is_read=True)
    except WrongReply as error:
        return times, str(error)
    return times, ""


def test_pieces_of_late_replies_are_gone_before_the_last_attempt() -> None:
    times, said = attempts_of([COMM_RX_CORRUPT, COMM_RX_CORRUPT, COMM_SUCCESS])
    assert times[1] == times[0] and times[2] - times[1] >= 0.05 and not said
    _, said = attempts_of(3 * [COMM_RX_CORRUPT])
    assert "second servo with ID 1" in said and "too late because other programs keep this computer busy" in said
