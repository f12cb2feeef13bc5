"""The port on a real terminal device: bounded reads, and one clear error when the other end disappears."""

import os
import socket
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.errors import NoReply, PortLost, PortNotOpened
from hil.drivers.packet import Instruction, encode
from hil.drivers.port import NetworkPort, Port, open_port
from hil.drivers.sdk_port import SdkPort
from hil.drivers.servo import Servo
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


@pytest.mark.parametrize("answering", [2, None])
def test_a_servo_answered_with_anothers_id_is_not_called_silent(answering: int | None) -> None:
    clock, received = VirtualClock(), bytearray()

    def read(count: int, timeout: float) -> bytes:
        taken = bytes(received[:count])
        del received[:count]
        clock.wait_until(clock.now() + (0.0 if taken else timeout))
        return taken

    def write(_: bytes) -> None:
        if answering is not None:
            received.extend(encode(answering, Instruction.STATUS, b"\x00\xfc\x03\x2e"))

    port = Mock(clock=clock, baud=1_000_000, latency=1e-3, echoes=False, write=write, read=read)
    port.strangers, port.late_replies, port.growth = 0, 0, 1
    port.wire_time.return_value, port.has_input.return_value = 1e-4, False
    said = "does not answer" if answering is None else "Requests to .* are answered by ID 2 .* mixed up"
    with pytest.raises(NoReply, match=said):
        Servo(port, 1, load_control_table("XM430-W350")).read("ID")


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


class Remote:
    """A pyserial port on a network: it sees one waiting byte at most, and other calls wait for the other end."""

    def __init__(self, *received: bytes) -> None:
        self._timeout = 0.0
        self.waiting = list(received)

    timeout = property(lambda self: self._timeout)  # setting it would negotiate

    @property
    def in_waiting(self) -> int:
        return min(1, len(self.waiting))

    def read(self, count: int) -> bytes:
        if not self.waiting and self._timeout:
            return b"TRUE"[:count]
        return self.waiting.pop(0)[:count] if self.waiting else b""

    def write(self, data: bytes) -> int:
        return len(data)


def test_nothing_of_a_late_reply_on_a_network_is_taken_for_the_next_one() -> None:
    port = NetworkPort("socket://x", 1_000_000, Remote(b"a late reply", b"and another"))
    assert port.ask(b"request", 4, port.reply_time(0.1, 7), port.clock.now()) == b"TRUE"
    assert port.overheard == b"a late reply"
    port = NetworkPort("rfc2217://x", 1_000_000, Remote(b"a late reply", b"and another"))
    port.discard_input()
    assert port.read(4, 0.1) == b"TRUE"


def test_two_writes_over_tcp_are_not_held_back_and_a_closed_connection_is_noticed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}", 1_000_000)
        other, _ = server.accept()
        assert port._serial._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        other.close()
        with pytest.raises(PortLost, match="disconnected"):
            port.read(1, 5.0)
        with pytest.raises(PortLost, match="disconnected"):
            port.discard_input()
        port.close()


def test_a_handler_that_returns_early_is_read_on_until_time_is_up() -> None:
    clock = VirtualClock()
    parts = [b"ab", b"cd", b""]
    opened = SimpleNamespace(timeout=None, clock=clock, read=lambda _: parts.pop(0))
    assert Port("early://", 1_000_000, opened).read(4, 0.01) == b"abcd" and parts == [b""]
    assert Port("early://", 1_000_000, opened).read(4, 0.01) == b""


class Line:
    """A device with a scripted servo behind it, in a time of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, is_wired: bool) -> None:
        self.now, self.is_wired, self.answers = 100.0, is_wired, True
        self.looks = 0
        self.late = b""
        """Reply that arrives right behind the next request."""
        self._far, near = os.openpty()
        tty.setraw(near)
        os.set_blocking(self._far, False)
        self._near = near
        self.port = open_port(os.ttyname(near), 1_000_000)
        self._ready = self.port._wait_ms  # type: ignore[attr-defined]
        self.port._wait_ms = self.wait  # type: ignore[attr-defined]
        monkeypatch.setattr("hil.drivers.port.descriptor_port._now", lambda: self.now)
        monkeypatch.setattr("hil.drivers.port.descriptor_port.select", SimpleNamespace(select=self.select))

    def wait(self, milliseconds: int) -> object:
        """What the port's poll returns; a servo answers while the port waits."""
        if milliseconds == 0:
            self.looks += 1
        elif self.late:
            os.read(self._far, 64)
            self.send(self.late)
            self.late = b""
        elif not self._ready(0):
            self._answer()
        return self._ready(0)

    def select(self, *_: object) -> tuple[list[int], list[int], list[int]]:
        if not self._ready(0):
            self._answer()
        return [self._near] if self._ready(0) else [], [], []

    def _answer(self) -> None:
        self.now += 1e-3 if self.is_wired else 1e-5
        with suppress(BlockingIOError):
            request = os.read(self._far, 64)
            if self.answers:
                self.send(request[:1] + b"-right")

    def send(self, data: bytes) -> None:
        os.write(self._far, data)

    def ask(self, letter: bytes) -> bytes:
        return self.port.ask(letter * 30, 7, self.port.reply_time(0.05, 30), self.now)

    def settle(self, count: int = 150) -> None:
        for _ in range(count):
            assert self.ask(b"a") == b"a-right"

    def close(self) -> None:
        self.port.close()
        os.close(self._near)
        os.close(self._far)


@pytest.fixture
def wired(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    line = Line(monkeypatch, is_wired=True)
    yield line
    line.close()


def test_pending_input_is_looked_for_only_until_the_line_has_proved_itself(wired: Line) -> None:
    wired.settle()
    looks = wired.looks
    assert 0 < looks < 150
    assert wired.ask(b"b") == b"b-right" and wired.looks == looks


@pytest.mark.parametrize("pending", [b"a-right", b"a-ri", b"another-master's"])
def test_pending_input_is_never_taken_for_the_reply(wired: Line, pending: bytes) -> None:
    for line_has_proved_itself in (False, True):
        if line_has_proved_itself:
            wired.settle()
        wired.send(pending)
        assert wired.ask(b"b") == b"b-right"
        assert wired.port.overheard == pending
        wired.port.overheard = b""


def test_pending_input_before_a_lost_reply_is_no_reply_either(wired: Line) -> None:
    wired.settle()
    wired.send(b"a-right")
    wired.answers = False
    assert wired.ask(b"b") == b""


@pytest.mark.parametrize("event", ["pending", "lost"])
def test_after_pending_input_or_a_lost_reply_the_port_looks_again(wired: Line, event: str) -> None:
    wired.settle()
    if event == "pending":
        wired.send(b"a-right")
    wired.answers = event != "lost"
    wired.ask(b"b")
    looks, wired.answers = wired.looks, True
    wired.ask(b"c")
    assert wired.looks == looks + 1


def test_a_line_that_answers_sooner_than_its_baud_rate_allows_is_always_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = Line(monkeypatch, is_wired=False)
    line.settle()
    assert line.looks == 150
    line.send(b"a-right")
    assert line.ask(b"b") == b"b-right" and line.port.overheard == b"a-right"
    line.close()


def test_a_reply_that_was_lost_and_arrives_behind_the_next_request_does_not_make_a_line_fast(wired: Line) -> None:
    wired.settle()
    wired.answers = False
    assert wired.ask(b"a") == b""
    wired.answers, wired.late = True, b"a-right"
    wired.ask(b"b")  # too early: the caller can tell by the time
    wired.settle(300)
    looks = wired.looks
    assert wired.ask(b"c") == b"c-right" and wired.looks == looks
