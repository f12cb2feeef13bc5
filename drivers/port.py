"""A serial port that cannot hang: any pyserial URL, bounded reads, and PortLost when the cable is unplugged.

Open one with `open_port`. `Port` does its I/O through pyserial and so supports every URL that pyserial does;
`NetworkPort` avoids pyserial's waits on a network; `DescriptorPort` reads and writes a local device directly, at half
pyserial's cost per cycle.
"""

import contextlib
import os
import select
import socket
import termios
import time
from typing import Any, NamedTuple

import serial

from hil.drivers.adapter.device import (
    adapter_name,
    device_of,
    is_pseudo_terminal,
    keep_others_out,
    other_users,
    true_baud,
)
from hil.drivers.adapter.latency import WANTED_MS, adapter_latency, latency_timer, read_latency_ms, write_latency_ms
from hil.drivers.clock import Clock, WallClock
from hil.drivers.errors import NotPermitted, PortLost, PortNotOpened

_now = time.perf_counter
_FAILURES = (OSError, termios.error)
# OSError covers SerialException. An unplugged cable makes flushing the input raise termios.error, which is no OSError.

_PENDING_FAILURES = (*_FAILURES, TypeError)
# pyserial counts the pending bytes of a port without checking whether it has been closed.

_REASONS = {
    "No such file": "there is no such device",
    "Inappropriate ioctl": "it is not a serial port",
    "Permission denied": "permission denied",
    "Is a directory": "it is a folder, not a serial port",
    "resource busy": "it is in use",
}
"""Explanations of the operating system's error messages."""

_MOST_OVERHEARD = 4096
"""Maximum number of pending bytes that are examined; the rest are discarded."""

_LOOKS = 100
"""Number of consecutive replies, all complete and none too early, after which `DescriptorPort.ask` no longer checks for
pending input in advance: on such a line, pending input is detected because it arrives too early.
"""

_LOOKS_AFTER_LOSS = 2 * _LOOKS
"""Value of `_LOOKS` after pending input or a lost reply, since a late reply may then arrive at any time."""

_ALWAYS = 1 << 62
"""Value of `_LOOKS` for a line whose replies usually arrive earlier than its baud rate allows, such as a pty."""

_EARLY_BITS = 9.0
"""Assumed number of bits per transmitted byte. A reply counts as early if it arrives before the request can have been
transmitted with this many bits per byte. The true number is ten.
"""

_BAUD_TOLERANCE = 0.03
"""Largest relative baud rate error at which bytes are still received."""

GROWTH = 3
"""Value of `Port.growth` without torque: an adapter may delay replies for longer than the first attempts take."""

_WRITE_PATIENCE_S = 0.1
"""How long a device may refuse to accept bytes before it counts as lost [s]."""


def open_port(url: str, baud: int) -> "Port":
    """Open a device or pyserial URL; raises PortNotOpened, whose message states the reason and the remedy."""
    try:
        # exclusive: a second program on the same bus would steal replies and send its own goals.
        opened = serial.serial_for_url(url, baudrate=baud, timeout=0, exclusive=True)
    except (OSError, termios.error, ValueError) as error:
        kind = NotPermitted if "Permission denied" in str(error) else PortNotOpened
        raise kind(f"Cannot open port {url!r}: {_why(error, baud)}. {_advice(error, url)}".rstrip()) from error
    if hasattr(opened, "_socket"):
        return NetworkPort(url, baud, opened)
    if type(opened) is not serial.Serial:
        return Port(url, baud, opened)
    try:
        _claim(url, opened)
        _check_baud(url, opened, baud)
    except PortNotOpened:
        opened.close()
        raise
    return DescriptorPort(url, baud, opened)


def _claim(url: str, opened: serial.Serial) -> None:
    """Keep other programs from opening the device; raise PortNotOpened if one already has it open."""
    if is_pseudo_terminal(url):
        return
    keep_others_out(opened.fileno())
    if users := other_users(url):
        raise PortNotOpened(
            f"Cannot open port {url!r}: it is already open in {' and '.join(users)}, which would steal replies or send "
            "goals. Close that program first."
        )


def _check_baud(url: str, opened: serial.Serial, baud: int) -> None:
    """Raise PortNotOpened if the adapter runs at another baud rate."""
    actual = true_baud(opened.fileno())
    if actual is not None and abs(actual - baud) > _BAUD_TOLERANCE * baud:
        raise PortNotOpened(
            f"Port {url!r} cannot be set to {baud} baud: its adapter runs at {actual} instead. Use a lower rate, or "
            "another adapter."
        )


class ReplyTime(NamedTuple):
    """Times at which a reply may arrive, counted from the start of its request; created by `Port.reply_time`.

    timeout: when the reply counts as lost [s]. whole_ms: `timeout` in whole milliseconds. earliest: earliest time at
    which the request can have been transmitted [s].
    """

    timeout: float
    whole_ms: int
    earliest: float


class Port:
    """An open serial port. Every method but `close` raises PortLost when the device fails.

    After PortLost, methods may be called again; they fail until `reopen` succeeds. `latency` is the longest time
    that the adapter may hold back a reply [s].
    """

    def __init__(self, url: str, baud: int, opened: Any) -> None:
        self.url = url
        self.baud = baud
        self.latency = adapter_latency(url)
        self.off_wire = 0.0
        """Time that the fastest of a few requests took in addition to its time on the wire [s]; 0 if not measured."""
        self.latency_measured = False
        """Whether `latency` was measured, because replies arrive later than expected from this kind of adapter."""
        self.echoes = False
        """Whether the adapter echoes what it sends; detected during set-up."""
        self.overheard = b""
        """Bytes that `ask` found pending before a request and set aside: late replies, or replies to another master."""
        self.strangers = 0
        """Number of another master's instructions received during set-up work."""
        self.late_replies = 0
        """Number of late replies during set-up work since torque was last switched on."""
        self.growth = GROWTH
        """Factor by which set-up work waits longer for each further attempt; 1 while servos have torque."""
        self._serial = opened
        self._timeout: float | None = opened.timeout
        self.clock: Clock = getattr(opened, "clock", None) or WallClock()
        self.is_open = True

    @property
    def has_baud(self) -> bool:
        """Whether setting the baud rate has an effect; over TCP the remote end determines it."""
        return not self.url.startswith("socket://")

    def wire_time(self, count: int) -> float:
        """Return the wire time [s] of `count` bytes (8 data bits, one start and one stop bit each)."""
        return count * 10 / self.baud

    def reply_time(self, timeout: float, sent: int) -> ReplyTime:
        """Return the ReplyTime that `ask` needs for a request of `sent` bytes with this timeout [s]."""
        return ReplyTime(timeout, int(timeout * 1e3), _EARLY_BITS * sent / self.baud)

    def write(self, data: bytes) -> None:
        """Send bytes; returns when the device has accepted them, not when they have been transmitted."""
        try:
            self._serial.write(data)
        except _FAILURES as error:
            raise self._lost(error) from error

    def read(self, count: int, timeout: float) -> bytes:
        """Return up to `count` bytes; fewer if they have not arrived within `timeout` [s].

        A URL handler may return early, with only some of the bytes; the rest is then read in the remaining time.
        """
        deadline = self.clock.now() + timeout
        received = part = self._read_once(count, timeout)
        while part and len(received) < count and (remaining := deadline - self.clock.now()) > 0.0:
            part = self._read_once(count - len(received), remaining)
            received += part
        return received

    def _read_once(self, count: int, timeout: float) -> bytes:
        try:
            # Setting the timeout makes pyserial query the terminal settings, so it is set only when it changes.
            if self._timeout != timeout:
                self._set_timeout(timeout)
            received: bytes = self._serial.read(count)
        except _FAILURES as error:
            raise self._lost(error) from error
        return received

    def _set_timeout(self, timeout: float) -> None:
        self._serial.timeout = self._timeout = timeout

    def ask(self, data: bytes, count: int, expected: ReplyTime, start: float) -> bytes:
        """Write at `start` [s, on the port's clock], then read until the timeout, as the control cycle does.

        Pending input is set aside first: otherwise a late reply would be taken for the reply to this request, and every
        later one would be a cycle late.
        """
        if self.has_input():
            self.put_aside()
        self.write(data)
        return self.read(count, expected.timeout)

    def put_aside(self) -> None:
        """Move received but unread bytes to `overheard`."""
        try:
            self.overheard = self._serial.read(self._serial.in_waiting)
        except _PENDING_FAILURES as error:
            raise self._lost(error) from error

    def has_input(self) -> bool:
        """Return whether received bytes are waiting to be read."""
        try:
            return bool(self._serial.in_waiting)
        except _PENDING_FAILURES as error:
            raise self._lost(error) from error

    def discard_input(self) -> None:
        """Discard received bytes that have not been read."""
        try:
            self._serial.reset_input_buffer()
        except _FAILURES as error:
            raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """Change the port's baud rate; raises PortNotOpened if the adapter does not support it."""
        try:
            self._serial.baudrate = baud
        except (*_FAILURES, ValueError) as error:
            raise PortNotOpened(f"Port {self.url!r} cannot be set to {baud} baud: {_why(error)}.") from error
        self.baud = baud

    def lower_latency(self) -> bool:
        """Set the adapter's latency timer to 1 ms; return False if this user is not permitted to set it."""
        file = latency_timer(self.url)
        if file is None or read_latency_ms(file) <= WANTED_MS:
            return True
        if not write_latency_ms(file):
            with contextlib.suppress(*_FAILURES, ValueError, NotImplementedError):
                self._serial.set_low_latency_mode(True)
        self.latency = adapter_latency(self.url)
        return read_latency_ms(file) <= WANTED_MS

    def close(self) -> None:
        """Close the port; has no effect if it is already closed or the cable is gone."""
        self.is_open = False
        with contextlib.suppress(*_FAILURES):
            self._serial.close()

    def reopen(self) -> bool:
        """Reopen the port once its device is back, e.g. after a USB hub reset; return whether it was reopened."""
        try:
            self._serial.close()
            self._serial.open()
        except (*_FAILURES, ValueError):
            return False
        return True

    def _lost(self, error: BaseException) -> PortLost:
        if not self.is_open:
            return PortLost(f"Port {self.url!r} was closed.")
        return PortLost(f"Port {self.url!r} failed: {_why(error)}. Is the cable plugged in and the adapter powered?")


class NetworkPort(Port):
    """A port on a network, `socket://` or `rfc2217://`. Reading never negotiates with the other end."""

    def __init__(self, url: str, baud: int, opened: Any) -> None:
        super().__init__(url, baud, opened)
        self._send_at_once()

    def reopen(self) -> bool:
        if is_back := super().reopen():
            self._send_at_once()
        return is_back

    def _send_at_once(self) -> None:
        # Otherwise TCP holds back the second of two writes until the first is acknowledged, for 40 ms.
        if line := getattr(self._serial, "_socket", None):
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _set_timeout(self, timeout: float) -> None:
        # pyserial's own setter configures the port again, which takes 50 ms with RFC 2217.
        self._serial._timeout = self._timeout = timeout

    def put_aside(self) -> None:
        self.overheard = self._read_once(_MOST_OVERHEARD, 0.0)  # `in_waiting` of a socket is never more than 1
        self.discard_input()

    def discard_input(self) -> None:
        # pyserial's own method waits for the other end with RFC 2217, and does not notice a closed connection.
        while self._read_once(_MOST_OVERHEARD, 0.0):
            pass


class DescriptorPort(Port):
    """A local device, read and written through its file descriptor."""

    def __init__(self, url: str, baud: int, opened: Any) -> None:
        super().__init__(url, baud, opened)
        self._adapter = adapter_name(url)
        self._looks = _LOOKS
        """Number of further requests for which `ask` checks for pending input before it writes."""
        self._use(opened)

    def _use(self, opened: Any) -> None:
        self._serial = opened
        self._descriptor: int = opened.fileno()
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        self._wait_ms = poll.poll

    def reopen(self) -> bool:
        # The device may have another name now, and its former name may be that of another arm's adapter.
        self._forget_descriptor()
        with contextlib.suppress(*_FAILURES):
            self._serial.close()
        is_pty = not self._adapter and is_pseudo_terminal(self.url)
        device = self.url if is_pty else device_of(self._adapter)
        if device is None:
            return False
        try:
            self._use(open_port(device, self.baud)._serial)
        except PortNotOpened:
            return False
        self.url = device
        return True

    def write(self, data: bytes) -> None:
        try:
            written = os.write(self._descriptor, data)
            if written < len(data):
                self._write_rest(data[written:])
        except BlockingIOError:
            self._write_rest(data)
        except OSError as error:
            raise self._lost(error) from error

    def read(self, count: int, timeout: float) -> bytes:
        try:
            return self._read_on(b"", count, _now() + timeout)
        except (OSError, ValueError) as error:  # ValueError: closed
            raise self._lost(error) from error

    def ask(self, data: bytes, count: int, expected: ReplyTime, start: float) -> bytes:
        # One Python frame for the whole transaction, and three system calls in the normal case: after a wait of a
        # millisecond the caches are cold, and every further call costs several microseconds.
        timeout, whole_ms, earliest = expected
        try:
            looks = self._looks
            if looks and self._wait_ms(0):
                self.put_aside()
                looks = max(looks, _LOOKS_AFTER_LOSS)
            written = os.write(self._descriptor, data)
            if written < len(data):
                self._write_rest(data[written:])
            if self._wait_ms(whole_ms):
                if _now() - start < earliest:
                    if not looks:
                        return self._ask_behind_pending(count, start + earliest, start + timeout)
                    if looks <= _LOOKS:
                        looks = _ALWAYS
                received = os.read(self._descriptor, count)
                if len(received) == count:
                    if looks:
                        self._looks = looks - 1
                    return received
                self._check_alive(received)
            else:
                received = b""
            return self._ask_on(received, count, start + timeout, looks)
        except BlockingIOError:
            self._write_rest(data)
            return self.read(count, timeout)
        except OSError as error:
            raise self._lost(error) from error

    def _ask_on(self, received: bytes, count: int, deadline: float, looks: int) -> bytes:
        """Read the rest of a reply that is still incomplete after a wait of whole milliseconds."""
        received = self._read_on(received, count, deadline)
        self._looks = max(0, looks - 1) if len(received) == count else max(looks, _LOOKS_AFTER_LOSS)
        return received

    def _ask_behind_pending(self, count: int, early_until: float, deadline: float) -> bytes:
        """Set aside what arrives before the request can have been transmitted, then read the reply as `ask` does."""
        self._looks = _LOOKS_AFTER_LOSS
        while select.select([self._descriptor], [], [], max(0.0, deadline - _now()))[0]:
            is_early = _now() < early_until
            received = os.read(self._descriptor, count)
            self._check_alive(received)
            if not is_early:
                return self._read_on(received, count, deadline)
            self.overheard += received
        return b""

    def set_baud(self, baud: int) -> None:
        former = self.baud
        super().set_baud(baud)
        try:
            _check_baud(self.url, self._serial, baud)
        except PortNotOpened:
            super().set_baud(former)
            raise

    def put_aside(self) -> None:
        try:
            self.overheard = os.read(self._descriptor, _MOST_OVERHEARD)
        except OSError as error:
            raise self._lost(error) from error
        self.discard_input()

    def discard_input(self) -> None:
        try:
            termios.tcflush(self._descriptor, termios.TCIFLUSH)
        except (*_FAILURES, ValueError) as error:  # ValueError: closed
            raise self._lost(error) from error

    def close(self) -> None:
        self._forget_descriptor()
        super().close()

    def _forget_descriptor(self) -> None:
        """Never use the closed descriptor's number again, since it may soon be that of another file."""
        self._descriptor = -1
        self._wait_ms = _never_ready

    def _read_on(self, received: bytes, count: int, deadline: float) -> bytes:
        """Read the rest of a fragmented reply. Uses select because poll only has a resolution of one millisecond."""
        while len(received) < count:
            remaining = max(0.0, deadline - _now())
            if not select.select([self._descriptor], [], [], remaining)[0]:
                break
            more = os.read(self._descriptor, count - len(received))
            self._check_alive(more)
            received += more
        return received

    def _check_alive(self, received: bytes) -> None:
        if not received:
            raise OSError(
                "the device reports data but returns none; it was unplugged, or another program is reading from it"
            )

    def _write_rest(self, data: bytes) -> None:
        """Write the bytes that the device did not accept at once, as its buffer drains."""
        deadline = _now() + self.wire_time(len(data)) + _WRITE_PATIENCE_S
        try:
            while data:
                remaining = deadline - _now()
                if remaining <= 0:
                    raise TimeoutError(f"it accepts no more bytes; {len(data)} were not sent")
                if select.select([], [self._descriptor], [], remaining)[1]:
                    data = data[os.write(self._descriptor, data) :]
        except (OSError, ValueError) as error:
            raise self._lost(error) from error


def _never_ready(_timeout_ms: float | None = None, /) -> list[tuple[int, int]]:
    raise OSError("the port was closed")


def _why(error: BaseException, baud: int | None = None) -> str:
    """Return the reason for a failure, without the exception text's error numbers and repetitions."""
    if isinstance(error, TypeError):  # see _PENDING_FAILURES
        return "it is closed"
    text = str(error.args[-1] if error.args else error)
    of_device = "open port" in text or "configure port" in text
    for known, said in _REASONS.items():
        if of_device and known in text:
            return said
    at = "" if baud is None else f" (at {baud} baud)"
    return f"{text.rstrip('.') or type(error).__name__}{at}"


def _advice(error: BaseException, url: str) -> str:
    text = str(error)
    if "Permission denied" in text:
        return "Add yourself to the port's group (`sudo usermod -aG dialout $USER`), then log out and in again."
    if "exclusively lock" in text or "busy" in text:
        return (
            "Another program has it open; close that program first. ModemManager holds new ports open for half a "
            "minute."
        )
    if "No such file" in text and "://" in url:
        return (
            "The file in this URL does not exist. A relative path starts at the configuration's folder or, outside a "
            "configuration, at the working directory."
        )
    if "No such file" in text:
        return "Is the adapter plugged in? `hil scan` lists the ports that exist."
    if "ioctl" in text:
        return "The adapter's port is usually /dev/ttyUSB0 or /dev/ttyACM0; `hil scan` lists those that exist."
    return ""
