"""Opens serial devices and pyserial URLs, and describes why a port cannot be opened or has failed."""

import termios
from typing import Any

import serial

from hil.drivers.adapter.device import is_pseudo_terminal, keep_others_out, other_users, true_baud
from hil.drivers.errors import NotPermitted, PortNotOpened

FAILURES = (OSError, termios.error)
# OSError covers SerialException. If the cable is unplugged, flushing the input raises termios.error, a separate class.

_REASONS = {
    "No such file": "there is no such device",
    "Inappropriate ioctl": "it is not a serial port",
    "Permission denied": "permission denied",
    "Is a directory": "it is a folder, not a serial port",
    "resource busy": "it is in use",
}
"""Explanations of the operating system's error messages."""

_BAUD_TOLERANCE = 0.03
"""Largest relative baud rate error at which bytes are still received."""


def open_serial(url: str, baud: int) -> Any:
    """Open a device or URL as pyserial does, but refuse a device that another program has open or that does not run at
    the requested baud rate. Raises PortNotOpened.
    """
    try:
        # exclusive: a second program on the same bus would steal replies and send its own goals.
        line = serial.serial_for_url(url, baudrate=baud, timeout=0, exclusive=True)
    except (OSError, termios.error, ValueError) as error:
        kind = NotPermitted if "Permission denied" in str(error) else PortNotOpened
        raise kind(f"Cannot open port {url!r}: {why(error, baud)}. {_advice(error, url)}".rstrip()) from error
    if type(line) is not serial.Serial:
        return line
    try:
        _claim(url, line)
        check_baud(url, line, baud)
    except PortNotOpened:
        line.close()
        raise
    return line


def _claim(url: str, opened: serial.Serial) -> None:
    """Keep other programs from opening the device; raise PortNotOpened if another program already has it open."""
    if is_pseudo_terminal(url):
        return
    keep_others_out(opened.fileno())
    if users := other_users(url):
        raise PortNotOpened(
            f"Cannot open port {url!r}: it is already open in {' and '.join(users)}, which would steal replies or send "
            "goals. Close that program first."
        )


def check_baud(url: str, opened: serial.Serial, baud: int) -> None:
    """Raise PortNotOpened if the adapter does not run at the requested baud rate."""
    actual = true_baud(opened.fileno())
    if actual is not None and abs(actual - baud) > _BAUD_TOLERANCE * baud:
        raise PortNotOpened(
            f"Port {url!r} cannot be set to {baud} baud: its adapter runs at {actual} instead. Use a lower rate, or "
            "another adapter."
        )


def why(error: BaseException, baud: int | None = None) -> str:
    """Return the reason for a failure, without the exception text's error numbers and repetitions."""
    if isinstance(error, TypeError):  # pyserial uses the descriptor of a closed port, which is None
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
            "The file in this URL does not exist. A relative path is resolved from the configuration's folder or, "
            "outside a configuration, from the working directory."
        )
    if "No such file" in text:
        return "Is the adapter plugged in? `hil scan` lists the ports that exist."
    if "ioctl" in text:
        return "The adapter's port is usually /dev/ttyUSB0 or /dev/ttyACM0; `hil scan` lists those that exist."
    return ""
