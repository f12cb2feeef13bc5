"""How long cutting and reading torque takes where servos are silent."""

from collections.abc import Callable

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import TorqueNotOff
from hil.drivers.torque.off import is_torque_on
from tests.support.bench import servos

Make = Callable[..., BusConfig]


def seconds(bus: ServoBus, action: Callable[[], object]) -> float:
    """Time that an action takes [s]."""
    begun = bus.port.clock.now()
    action()
    return bus.port.clock.now() - begun


@pytest.mark.parametrize("again", [False, True])
def test_without_an_armed_watchdog_cutting_torque_does_not_wait_for_one(fake_config: Make, again: bool) -> None:
    """Neither before torque was ever on, nor if another program has switched it on since."""
    with ServoBus.open(fake_config()) as bus:
        if again:
            with bus.torque(watchdog=0.5):
                pass
        servos(bus)[2].connected = False
        cut = (lambda: bus.cut_foreign_torque(list(bus.drives))) if again else bus.torque_off
        assert seconds(bus, cut) < 0.6, "silent servos are asked several times"


def test_only_while_torque_is_off_each_attempt_waits_longer_than_the_one_before(fake_config: Make) -> None:
    """An adapter may delay replies; but the arm must not be left unwatched for long."""
    with ServoBus.open(fake_config()) as bus:
        second = list(bus.drives.values())[1]
        with pytest.raises(TorqueNotOff), bus.torque(watchdog=0.1):
            servos(bus)[2].connected = False
            on = seconds(bus, lambda: is_torque_on(second))
        off = seconds(bus, lambda: is_torque_on(second))
    assert on < 0.1 < off
