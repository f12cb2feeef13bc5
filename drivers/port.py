"""A serial port that cannot wedge: any pyserial URL, bounded reads, one error when the cable is gone.

Two classes: `Port` for us, and `SdkPort`, which lets `dynamixel-sdk` work on the same open port.
"""

import contextlib
import termios
from typing import Protocol, cast

import serial

from drivers.clock import Clock, WallClock
from drivers.errors import PortLost, PortNotOpened

ADAPTER_LATENCY_S = 0.016
"""Latency timer of an FTDI adapter as it comes from the factory: the longest that a reply may lie in it."""

_FAILURES = (OSError, termios.error)
# OSError covers SerialException. A pulled cable gives termios.error from reset_input_buffer.


class _Serial(Protocol):
    """What we use of a pyserial port."""

    timeout: float | None

    def read(self, size: int = ..., /) -> bytes: ...
    def write(self, data: bytes | bytearray, /) -> int | None: ...
    def reset_input_buffer(self) -> None: ...
    def close(self) -> None: ...


class Port:
    """An open serial port.

    Raises PortNotOpened from the constructor and PortLost from everything else; after PortLost the port may be used
    again (a replugged cable needs a new Port) and `close` never raises.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        self.baud = baud
        try:
            self._serial = cast(_Serial, serial.serial_for_url(url, baudrate=baud, timeout=0))
        except (*_FAILURES, ValueError) as error:
            raise PortNotOpened(f"Cannot open port {url!r} at {baud} baud: {_why(error)}") from error
        self.clock: Clock = getattr(self._serial, "clock", None) or WallClock()
        self.is_open = True

    def wire_time(self, count: int) -> float:
        """Seconds that `count` bytes take on the wire (8 data bits, start and stop)."""
        return count * 10 / self.baud

    def write(self, data: bytes | bytearray) -> None:
        try:
            self._serial.write(data)
        except _FAILURES as error:
            raise self._lost(error) from error

    def read(self, count: int, timeout: float) -> bytes:
        """Up to `count` bytes: fewer when they have not come after `timeout` [s]."""
        try:
            # Setting the timeout makes pyserial look at the terminal's settings, so only when it changes.
            if self._serial.timeout != timeout:
                self._serial.timeout = timeout
            return self._serial.read(count)
        except _FAILURES as error:
            raise self._lost(error) from error

    def discard_input(self) -> None:
        """Throw away what has been received and not read."""
        try:
            self._serial.reset_input_buffer()
        except _FAILURES as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Close; harmless when closed or when the cable is gone."""
        self.is_open = False
        with contextlib.suppress(*_FAILURES):
            self._serial.close()

    def _lost(self, error: BaseException) -> PortLost:
        return PortLost(f"Port {self.url!r} failed: {_why(error)}. Is the cable plugged in and the adapter powered?")


class SdkPort:
    """The port that `dynamixel-sdk`'s packet handler works on, in place of its own PortHandler.

    Against that one: reads wait instead of polling, time is the port's clock, and a failure cannot leave the port
    marked as in use, after which torque could never be switched off. Method names are the SDK's.
    """

    def __init__(self, port: Port, reply_timeout: float = ADAPTER_LATENCY_S + 2e-3) -> None:
        self._port = port
        self._reply_timeout = reply_timeout
        self._deadline = 0.0

    @property
    def is_using(self) -> bool:
        return False

    @is_using.setter
    def is_using(self, value: bool) -> None:
        """The SDK sets it around each exchange and leaves it set after an exception: not kept."""

    def getBaudRate(self) -> int:  # noqa: N802
        return self._port.baud

    def clearPort(self) -> None:  # noqa: N802
        self._port.discard_input()

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self._port.write(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        remaining = self._deadline - self._port.clock.now()
        return self._port.read(length, max(0.0, remaining))

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        # Twice the reply's wire time: once for the instruction before it, once for the reply.
        self._set_timeout(2 * self._port.wire_time(packet_length) + self._reply_timeout)

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        self._set_timeout(msec / 1000)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._port.clock.now() >= self._deadline

    def _set_timeout(self, timeout: float) -> None:
        self._deadline = self._port.clock.now() + timeout


def _why(error: BaseException) -> str:
    text = str(error.args[-1] if error.args else error)
    return text.rstrip(".") or type(error).__name__
