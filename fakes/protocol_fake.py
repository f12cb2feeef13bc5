"""The pyserial URL `fake://ARM`: a serial port with a fake arm behind it, in virtual or real time.

After `fakes.register()`, `serial.serial_for_url("fake://configs/fake_two_link.toml")` opens the arm described in that
file's [fake] table. A path without a leading slash is relative to the working directory; a bare name that is not a file
is one of the arms bundled with hil (`fake://koch`; see `hil.fakes.names`). `open_fake` does the same from Python
without a file. pyserial finds this module by its name.

Time is that of `port.clock`: a program must wait on that clock (in `port.wait` or `read`), because wall-clock time
does not move the arm. In particular, dynamixel-sdk's own port handler, which polls with timeout 0 against
`time.time()`, receives no replies. With `fake://PATH/TO/ARM.toml?time=real`, the arm runs in real time and works with
any program.

An unplugged cable (see `hil.fakes.bus.faults`) acts as on Linux: writing and reading raise `serial.SerialException`,
and `reset_input_buffer` raises `termios.error`. The port must then be closed and reopened once the cable is replugged.
"""

import errno
import math
import os
import termios
from pathlib import Path

import serial
from serial.serialutil import SerialBase

from hil.drivers.clock import Clock, WallClock
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import DescriptionError, FakeArm, load_fake, make_bus
from hil.fakes.plants.errors import PlantError

SCHEME = "fake://"
REAL_TIME = "?time=real"
_LIKE_NO_PARITY = (serial.PARITY_NONE, serial.PARITY_MARK)
"""Parities with which a receiver without parity still reads the bytes: a mark parity bit looks like a stop bit."""


class _Unplugged(serial.SerialException):
    """The cable has been unplugged since the port was opened."""

    def __init__(self) -> None:
        super().__init__(f"[Errno {errno.EIO}] {os.strerror(errno.EIO)}: the fake adapter was unplugged")


class FakeSerial(SerialBase):
    """A pyserial port connected to a fake bus.

    The arm is created when the port is first opened and lives as long as the port object. Two port objects never share
    an arm.

    A port has the attributes `clock` and `bus` in addition to pyserial's interface.
    """

    def __init__(
        self,
        port: str | None = None,
        *args: object,
        description: FakeArm | None = None,
        clock: Clock | None = None,
        **kwargs: object,
    ) -> None:
        self._description = description
        self._may_be_real = clock is None
        self.clock: Clock = clock or VirtualClock()
        self._bus: FakeBus | None = None
        self._pulls = 0
        self._is_understood = True
        super().__init__(port, *args, **kwargs)  # type: ignore[arg-type]  # pyserial's long list of settings

    @property
    def bus(self) -> FakeBus:
        """The bus and its servos; raises `serial.PortNotOpenError` before the port is opened for the first time."""
        if self._bus is None:
            raise serial.PortNotOpenError
        return self._bus

    def open(self) -> None:
        """Open the port; raises `serial.SerialException` if the arm cannot be created."""
        if self.is_open:
            raise serial.SerialException(f"{self.name or SCHEME} is already open")
        if self._bus is None:
            if self._may_be_real and (self.port or "").endswith(REAL_TIME):
                self.clock = WallClock()  # pyserial names the port only after its object has been created
            self._bus = self._build()
        self._bus.notice_faults()
        if self._bus.cable_is_out:
            raise serial.SerialException(f"could not open port {self.name or SCHEME}: the cable is unplugged")
        self._pulls = self._bus.pulls
        self._reconfigure_port()
        self.is_open = True

    def _build(self) -> FakeBus:
        try:
            return make_bus(self._description or load_fake(_path(self.port)), self.clock)
        except (DescriptionError, PlantError, OSError) as error:
            raise serial.SerialException(str(error)) from error

    @property
    def timeout(self) -> float | None:
        """Longest wait of `read` on `clock` [s]; None waits forever."""
        return self._timeout

    @timeout.setter
    def timeout(self, timeout: float | None) -> None:
        # pyserial's own setter also configures the port again, which costs as much as a short read.
        try:
            is_valid = timeout is None or timeout >= 0
        except TypeError:
            is_valid = False
        if not is_valid:
            raise ValueError(f"Not a valid timeout: {timeout!r}")
        self._timeout = timeout

    def close(self) -> None:
        self.is_open = False

    def _reconfigure_port(self, force_update: bool = False) -> None:
        """Apply the baud rate and the frame format; the other settings have no effect here."""
        if self.baudrate <= 0:
            raise ValueError(f"the baud rate must be positive, not {self.baudrate}")
        if self._bus is not None:
            self._bus.baud = self.baudrate
        self._is_understood = self.bytesize == serial.EIGHTBITS and self.parity in _LIKE_NO_PARITY

    def read(self, size: int = 1) -> bytes:
        """Return up to `size` bytes, waiting on `clock` for at most the port's timeout.

        Where a real port with timeout None would wait forever, this read raises `serial.SerialException`; bytes already
        received can still be read.
        """
        bus = self._open_bus()
        timeout = self._timeout
        if timeout is None and bus.on_the_way < size:
            raise serial.SerialException(
                f"reading {size} bytes without a timeout would block forever: "
                f"only {bus.on_the_way} have arrived or are in transit; set a timeout"
            )
        taken = bus.read(size, math.inf if timeout is None else timeout)
        if len(taken) < size and self._pulls != bus.pulls:
            raise self._unplugged(bus)
        return taken

    def write(self, data: bytes | bytearray) -> int:  # type: ignore[override]  # pyserial's stub allows any buffer
        """Put bytes on the wire and return immediately, like a buffered driver.

        Servos reject bytes in a frame format other than 8N1. Such bytes are replaced by zeros, which take the same time
        and contain no packet.
        """
        self._open_bus().write(bytes(data) if self._is_understood else bytes(len(data)))
        return len(data)

    def wait(self, seconds: float) -> None:
        """Let the arm run for this time on `clock` (instantly in virtual time), and bring `bus` up to date.

        Bytes that arrive in the meantime can still be read afterwards. pyserial's own ports have no such method.
        """
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"cannot wait for {seconds} s")
        bus = self.bus
        self.clock.wait_until(self.clock.now() + seconds)
        bus.advance(self.clock.now())

    def flush(self) -> None:
        """Wait on `clock` until everything written has been sent."""
        self.clock.wait_until(self._open_bus().sent_by)

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have arrived but have not been read."""
        return self._open_bus().in_waiting

    def reset_input_buffer(self) -> None:
        """Drop the bytes that have arrived. Bytes still in transit are not dropped: they arrive later."""
        try:
            bus = self._open_bus()
        except _Unplugged as error:
            raise termios.error(errno.EIO, os.strerror(errno.EIO)) from error  # as a real port does
        bus.discard_input()

    def reset_output_buffer(self) -> None:
        """Check that the port is open, and do nothing else: all data written are already being sent."""
        self._open_bus()

    def cancel_read(self) -> None:
        """Do nothing: `read` does not block in virtual time, and in real time it ends at its timeout."""

    def cancel_write(self) -> None:
        """Do nothing: `write` never blocks."""

    @property
    def cts(self) -> bool:
        """False: the adapter's modem lines are not connected."""
        return False

    dsr = ri = cd = cts

    def _open_bus(self) -> FakeBus:
        bus = self._bus
        if not self.is_open or bus is None:
            raise serial.PortNotOpenError
        if bus.faults.next_change < math.inf:
            bus.notice_faults()
        if self._pulls != bus.pulls:
            raise self._unplugged(bus)
        return bus

    def _unplugged(self, bus: FakeBus) -> _Unplugged:
        """Wait until the cable is unplugged (the bus may have computed this ahead of time); return the error."""
        self.clock.wait_until(bus.pulled_at)
        return _Unplugged()

    def _update_rts_state(self) -> None:
        """Do nothing: this port has no RTS line. pyserial calls this when the setting changes."""

    def _update_dtr_state(self) -> None:
        """Do nothing: this port has no DTR line. pyserial calls this when the setting changes."""

    def _update_break_state(self) -> None:
        """Do nothing: this port has no break state. pyserial calls this when the setting changes."""


def open_fake(
    description: FakeArm, clock: Clock | None = None, *, baud: int = 1_000_000, timeout_s: float | None = 0.1
) -> FakeSerial:
    """Return an open port to the described arm, which runs on `clock` (by default a new `VirtualClock`)."""
    port = FakeSerial(None, description=description, clock=clock, baudrate=baud, timeout=timeout_s)
    port.open()
    return port


def serial_class_for_url(url: str) -> tuple[str, type[FakeSerial]]:
    """Return the port's name and class for a URL, as pyserial requires of a protocol handler module."""
    return url, FakeSerial


def _path(url: str | None) -> Path:
    path = (url or "").removeprefix(SCHEME).removesuffix(REAL_TIME)
    if not path:
        raise DescriptionError(f'"{url or ""}" does not name a file; use {SCHEME}PATH/TO/ARM.toml')
    if "?" in path:
        raise DescriptionError(f'"{url}": only "{REAL_TIME}" is allowed after the path')
    return Path(path)
