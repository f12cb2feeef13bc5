"""The port on a real terminal device: bounded reads, and one clear error when the other end disappears."""

import os
import time
from types import SimpleNamespace

import pytest

from hil.drivers.errors import PortLost, PortNotOpened
from hil.drivers.port import Port, open_port
from hil.drivers.sdk_port import SdkPort
from hil.fakes.bus.clock import VirtualClock


@pytest.fixture
def pty() -> tuple[int, str]:
    master, slave = os.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    return master, name


def test_a_port_that_does_not_exist_is_named() -> None:
    with pytest.raises(PortNotOpened, match=r"/dev/no-such-port.*there is no such device"):
        open_port("/dev/no-such-port", 1_000_000)


def test_an_unknown_url_scheme_is_not_opened() -> None:
    with pytest.raises(PortNotOpened, match="nonsense"):
        open_port("nonsense://x", 1_000_000)


def test_a_read_is_bounded_and_gives_what_came(pty: tuple[int, str]) -> None:
    master, name = pty
    port = open_port(name, 1_000_000)
    os.write(master, b"abc")
    started = time.monotonic()
    assert port.read(10, 0.05) == b"abc"
    assert time.monotonic() - started < 5.0
    port.close()
    os.close(master)


def test_input_can_be_discarded(pty: tuple[int, str]) -> None:
    master, name = pty
    port = open_port(name, 1_000_000)
    os.write(master, b"stale")
    time.sleep(0.01)
    port.discard_input()
    assert port.read(10, 0.0) == b""
    port.close()
    os.close(master)


@pytest.mark.parametrize("action", ["read", "write", "discard"])
def test_a_pulled_cable_is_port_lost_whatever_was_being_done(pty: tuple[int, str], action: str) -> None:
    master, name = pty
    port = open_port(name, 1_000_000)
    os.close(master)
    with pytest.raises(PortLost, match="cable"):
        {
            "read": lambda: port.read(1, 0.1),
            "write": lambda: port.write(b"x"),
            "discard": port.discard_input,
        }[action]()
    port.close()
    port.close()


def test_the_sdk_can_never_leave_the_port_marked_as_in_use(pty: tuple[int, str]) -> None:
    master, name = pty
    sdk_port = SdkPort(open_port(name, 1_000_000))
    sdk_port.is_using = True
    assert not sdk_port.is_using
    os.close(master)


def test_a_handler_that_returns_early_is_read_on_until_time_is_up() -> None:
    clock = VirtualClock()
    parts = [b"ab", b"cd", b""]
    opened = SimpleNamespace(timeout=None, clock=clock, read=lambda _: parts.pop(0))
    assert Port("early://", 1_000_000, opened).read(4, 0.01) == b"abcd" and parts == [b""]
    assert Port("early://", 1_000_000, opened).read(4, 0.01) == b""
