"""A local device, read and written through its file descriptor at half of pyserial's cost per cycle."""

import contextlib
import os
import select
import termios
import time
from typing import Any

from hil.drivers.adapter.device import adapter_name, device_of, is_pseudo_terminal
from hil.drivers.errors import PortNotOpened
from hil.drivers.port.opening import FAILURES, check_baud, open_serial
from hil.drivers.port.port import Port, ReplyTime

_now = time.perf_counter

_MOST_OVERHEARD = 4096
"""Maximum number of pending bytes that are examined; the rest are discarded."""

_LOOKS = 100
"""Number of consecutive replies, all complete and none too early, after which `DescriptorPort.ask` no longer checks for
pending input in advance. On such a line, pending input reveals itself: it is available sooner than any reply can be.
"""

_LOOKS_AFTER_LOSS = 2 * _LOOKS
"""Value of `_LOOKS` after pending input or a lost reply, since a late reply may then arrive at any time."""

_ALWAYS = 1 << 62
"""Value of `_LOOKS` for a line whose replies usually arrive earlier than its baud rate allows, such as a pty."""

_WRITE_PATIENCE_S = 0.1
"""How long a device may refuse to accept bytes before it counts as lost [s]."""


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
        # The device may have a different name now, and its former name may now belong to another arm's adapter.
        self._forget_descriptor()
        with contextlib.suppress(*FAILURES):
            self._serial.close()
        is_pty = not self._adapter and is_pseudo_terminal(self.url)
        device = self.url if is_pty else device_of(self._adapter)
        if device is None:
            return False
        try:
            self._use(open_serial(device, self.baud))
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
        """Set aside bytes received before the request can have been transmitted, then read the reply as `ask` does."""
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
            check_baud(self.url, self._serial, baud)
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
        except (*FAILURES, ValueError) as error:  # ValueError: closed
            raise self._lost(error) from error

    def close(self) -> None:
        self._forget_descriptor()
        super().close()

    def _forget_descriptor(self) -> None:
        """Forget the number of the closed descriptor, since another file may soon be opened under it."""
        self._descriptor = -1
        self._wait_ms = _never_ready

    def _read_on(self, received: bytes, count: int, deadline: float) -> bytes:
        """Read the rest of a fragmented reply. Uses select because poll has a resolution of only one millisecond."""
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
