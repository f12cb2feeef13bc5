"""The driver on a terminal device in real time: short experiments, lost replies, and unplugged cables."""

import gc
import os
import random
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import PortLost, PortNotOpened, TorqueNotOff
from hil.drivers.port import DescriptorPort, ReplyTime, open_port

from .conftest import JOINTS, ServedPty

Serve = Callable[[], ServedPty]


def config(pty: ServedPty) -> BusConfig:
    return BusConfig(pty.name, 1_000_000, JOINTS)


def patient(bus: ServoBus) -> ServoBus:
    """Prepare the bus with a long reply timeout, since the far end is a Python thread on a busy machine."""
    bus.port.latency = 0.2
    bus.prepare()
    return bus


def test_an_experiment_in_small(served_pty: Serve) -> None:
    pty = served_pty()
    with patient(ServoBus.connect(config(pty))) as bus:
        assert isinstance(bus.port, DescriptorPort)
        bus.check_identity()
        with bus.torque(watchdog=2.0):
            assert all(servo.torque_enabled for servo in pty.bus.servos.values())
            states = [bus.exchange([0.1, 0.0]) for _ in range(30)]
        assert not any(state.missing != (False, False) for state in states)
        assert bus.torque_off_report is not None and not bus.torque_off_report.unconfirmed
    assert not any(servo.torque_enabled for servo in pty.bus.servos.values())


def test_a_silent_servo_costs_one_sample_and_the_next_one_is_right(served_pty: Serve) -> None:
    pty = served_pty()
    with patient(ServoBus.connect(config(pty))) as bus:
        pty.bus.servos[2].connected = False
        assert bus.exchange([0.0, 0.0]).missing == (False, True)
        pty.bus.servos[2].connected = True
        state = bus.exchange([0.0, 0.0])
        assert state.missing == (False, False)
        assert state.position == pytest.approx((-1.5708, 0.0), abs=5e-3)


def test_a_second_program_is_kept_off_the_bus(served_pty: Serve) -> None:
    pty = served_pty()
    first = open_port(pty.name, 1_000_000)
    with pytest.raises(PortNotOpened, match="Another program has it open"):
        open_port(pty.name, 1_000_000)
    first.close()
    open_port(pty.name, 1_000_000).close()


def open_files() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("times", [8, pytest.param(100, marks=pytest.mark.slow)])
def test_pulled_and_replugged_cables(served_pty: Serve, times: int) -> None:
    """The same port name reappears each time, like that of a replugged adapter; each cable is unplugged mid-cycle."""
    before, causes = open_files(), set()
    for _ in range(times):
        pty = served_pty()
        bus = ServoBus.connect(config(pty))
        bus.port.latency = 0.2
        bus.prepare()
        with pytest.raises(TorqueNotOff) as caught, bus, bus.torque(watchdog=2.0):
            bus.exchange([0.1, 0.1])
            pty.pull()
            bus.exchange([0.1, 0.1])
        cause = caught.value.__context__
        causes.add((type(cause), str(cause).replace(pty.name, "PORT")))
        assert bus.torque_off_report is not None
        assert [joint for joint, _ in bus.torque_off_report.unconfirmed] == list(JOINTS)
        assert not bus.port.is_open
    assert len(causes) == 1
    assert causes.pop()[0] is PortLost
    assert open_files() < before + times, "none is left open per cable; other tests' threads may open one meanwhile"


@pytest.mark.parametrize("pulled", ["in the wait for a reply", "before the write"])
def test_after_a_pulled_cable_the_bus_says_that_torque_is_not_confirmed(served_pty: Serve, pulled: str) -> None:
    pty = served_pty()
    bus = patient(ServoBus.connect(config(pty)))
    with pytest.raises(TorqueNotOff, match="TORQUE OFF IS NOT CONFIRMED") as caught, bus, bus.torque(watchdog=2.0):
        if pulled == "before the write":
            pty.pull()
        else:

            def ask(data: bytes, count: int, expected: ReplyTime, start: float) -> bytes:
                bus.port.write(data)
                pty.pull()
                return bus.port.read(count, expected.timeout)

            bus.port.ask = ask  # type: ignore[method-assign]
        bus.exchange([0.1, 0.1])
    cause: Any = caught.value.__context__
    assert isinstance(cause, PortLost)
    assert str(cause).startswith(f"Port {pty.name!r} failed: ")
    assert "Is the cable plugged in" in str(cause)


def test_a_closed_port_says_so(served_pty: Serve) -> None:
    port = open_port(served_pty().name, 1_000_000)
    port.close()
    for action in (lambda: port.read(1, 0.0), lambda: port.write(b"x"), port.discard_input):
        with pytest.raises(PortLost, match="was closed"):
            action()
    port.close()


def test_a_device_that_takes_no_more_bytes_is_lost_and_does_not_wedge() -> None:
    master, slave = os.openpty()
    port = open_port(os.ttyname(slave), 1_000_000)
    with pytest.raises(PortLost, match="accepts no more bytes"):
        port.baud = 10**9  # not to wait long for room
        port.write(bytes(1_000_000))
    port.close()
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("way", ["write", "ask"])
def test_a_big_write_is_finished_as_the_device_makes_room(way: str) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = open_port(os.ttyname(slave), 1_000_000)
    sent = random.Random(1).randbytes(30_000)
    arrived = bytearray()

    def receive() -> None:
        while len(arrived) < len(sent):
            arrived.extend(os.read(master, 4096))
        os.write(master, b"all of it")

    receiver = threading.Thread(target=receive, daemon=True)
    receiver.start()
    if way == "write":
        port.write(sent)
        received = port.read(9, 5.0)
    else:
        received = port.ask(sent, 9, port.reply_time(5.0, len(sent)), port.clock.now())
    receiver.join(5.0)
    assert received == b"all of it" and bytes(arrived) == sent
    port.close()
    os.close(slave)
    os.close(master)
