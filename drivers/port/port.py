"""A serial port that cannot hang: bounded reads through pyserial, and PortLost when the cable is unplugged."""

import contextlib
from typing import Any, NamedTuple

from hil.drivers.adapter.latency import WANTED_MS, adapter_latency, latency_timer, read_latency_ms, write_latency_ms
from hil.drivers.clock import Clock, WallClock
from hil.drivers.errors import PortLost, PortNotOpened
from hil.drivers.port.opening import FAILURES, why

_PENDING_FAILURES = (*FAILURES, TypeError)
# pyserial counts the pending bytes of a port without checking whether it has been closed.

_EARLY_BITS = 9.0
"""Assumed number of bits per transmitted byte. A reply counts as early if it arrives before the request can have been
transmitted with this many bits per byte. The true number is ten.
"""

GROWTH = 3
"""Value of `Port.growth` while torque is off. Waits must grow because an adapter may delay a reply beyond the first
wait.
"""


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
        """Overhead of an exchange beyond its wire time [s]: the lowest of a few measured values; 0 if not measured."""
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
        """Factor by which the reply timeout grows with each attempt at a set-up exchange; 1 while torque is on."""
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
        """Send bytes. Returns as soon as the device has accepted the bytes, before they have been transmitted."""
        try:
            self._serial.write(data)
        except FAILURES as error:
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
        except FAILURES as error:
            raise self._lost(error) from error
        return received

    def _set_timeout(self, timeout: float) -> None:
        self._serial.timeout = self._timeout = timeout

    def ask(self, data: bytes, count: int, expected: ReplyTime, start: float) -> bytes:
        """Write at `start` [s, on the port's clock], then read until the timeout, as the control cycle does.

        Pending input is set aside first: otherwise, a late reply would be taken for the reply to this request, and
        every later reply would be used one cycle late.
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
        except FAILURES as error:
            raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """Change the port's baud rate; raises PortNotOpened if the adapter does not support it."""
        try:
            self._serial.baudrate = baud
        except (*FAILURES, ValueError) as error:
            raise PortNotOpened(f"Port {self.url!r} cannot be set to {baud} baud: {why(error)}.") from error
        self.baud = baud

    def lower_latency(self) -> bool:
        """Set the adapter's latency timer to 1 ms; return False if this user is not permitted to set it."""
        file = latency_timer(self.url)
        if file is None or read_latency_ms(file) <= WANTED_MS:
            return True
        if not write_latency_ms(file):
            with contextlib.suppress(*FAILURES, ValueError, NotImplementedError):
                self._serial.set_low_latency_mode(True)
        self.latency = adapter_latency(self.url)
        return read_latency_ms(file) <= WANTED_MS

    def close(self) -> None:
        """Close the port; has no effect if it is already closed or the cable is unplugged."""
        self.is_open = False
        with contextlib.suppress(*FAILURES):
            self._serial.close()

    def reopen(self) -> bool:
        """Reopen the port once its device is back, e.g. after a USB hub reset; return whether it was reopened."""
        try:
            self._serial.close()
            self._serial.open()
        except (*FAILURES, ValueError):
            return False
        return True

    def _lost(self, error: BaseException) -> PortLost:
        if not self.is_open:
            return PortLost(f"Port {self.url!r} was closed.")
        return PortLost(f"Port {self.url!r} failed: {why(error)}. Is the cable plugged in and the adapter powered?")
