"""The USB adapter's latency timer: how long the adapter may hold back a reply.

FTDI adapters (including the U2D2) buffer received data until 62 bytes have arrived or a timer has expired. The factory
setting of 16 ms limits the control cycle to 60 Hz. On Linux, root may set the timer in a sysfs file of the tty; the
port's "low latency" flag, which any user of the port may set, sets the timer to 1 ms.
"""

from pathlib import Path

FACTORY_MS = 16
WANTED_MS = 1

LOCAL_S = 1e-3
"""Assumed latency of a device without a latency timer [s]: CDC-ACM adapter (one USB frame), UART, pty or fake bus."""

REMOTE_S = 16e-3
"""Assumed latency of a port on a network [s]."""

BLUETOOTH_S = 60e-3
"""Assumed latency of a serial port over Bluetooth [s]."""

_SYSFS = Path("/sys")


def latency_timer(url: str, sysfs: Path = _SYSFS) -> Path | None:
    """Return the sysfs file of the port's latency timer; None if there is none (not an FTDI adapter, not Linux)."""
    if "://" in url:
        return None
    device = Path(url).resolve().name  # /dev/serial/by-id/... are symbolic links
    file = sysfs / "class" / "tty" / device / "device" / "latency_timer"
    return file if file.is_file() else None


def read_latency_ms(file: Path) -> int:
    """Return the timer's value [ms], or the factory setting if the adapter has just been unplugged."""
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return FACTORY_MS


def write_latency_ms(file: Path, value_ms: int = WANTED_MS) -> bool:
    """Set the timer; return whether the new value was read back. Requires root, or a udev rule that grants write
    access.
    """
    try:
        file.write_text(str(value_ms))
    except OSError:
        return False
    return read_latency_ms(file) == value_ms


def command_to_set(file: Path, value_ms: int = WANTED_MS) -> str:
    """Return the shell command that sets the timer as root; the setting lasts until the adapter is unplugged."""
    return f"echo {value_ms} | sudo tee {file}"


def adapter_latency(url: str, sysfs: Path = _SYSFS) -> float:
    """Return the longest time that the adapter of this port may hold back a reply [s]."""
    file = latency_timer(url, sysfs)
    if file is not None:
        return read_latency_ms(file) * 1e-3
    if Path(url).name.startswith("rfcomm"):
        return BLUETOOTH_S
    return REMOTE_S if "://" in url and not url.startswith("fake://") else LOCAL_S
