"""The USB adapter's latency timer: how long the adapter may hold back a reply.

FTDI adapters (U2D2 among them) buffer what they receive until 62 bytes have arrived or a timer has expired, 16 ms from
the factory, which limits a cycle to 60 Hz. On Linux the timer is a file of the tty's in sysfs, which only root may
write; the port's "low latency" flag sets it to 1 ms too, and any user of the port may set that one.
"""

from pathlib import Path

FACTORY_MS = 16
WANTED_MS = 1

LOCAL_S = 1e-3
"""Allowed for a device without a latency timer: a CDC-ACM adapter (one USB frame), a UART, a pty, the fake."""

REMOTE_S = 16e-3
"""Allowed for a port behind a network."""

BLUETOOTH_S = 60e-3
"""Allowed for a serial port over Bluetooth."""

_SYSFS = Path("/sys")


def latency_timer(url: str, sysfs: Path = _SYSFS) -> Path | None:
    """The sysfs file of the port's latency timer; None when it has none (no FTDI adapter, no Linux)."""
    if "://" in url:
        return None
    device = Path(url).resolve().name  # /dev/serial/by-id/... are links
    file = sysfs / "class" / "tty" / device / "device" / "latency_timer"
    return file if file.is_file() else None


def read_latency_ms(file: Path) -> int:
    """The timer's value. An adapter that was just unplugged counts as one from the factory."""
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return FACTORY_MS


def write_latency_ms(file: Path, value_ms: int = WANTED_MS) -> bool:
    """Set the timer; whether it then reads back so. Needs root, or a udev rule that opens the file."""
    try:
        file.write_text(str(value_ms))
    except OSError:
        return False
    return read_latency_ms(file) == value_ms


def command_to_set(file: Path, value_ms: int = WANTED_MS) -> str:
    """What to type when setting it was not permitted. It lasts until the adapter is unplugged."""
    return f"echo {value_ms} | sudo tee {file}"


def adapter_latency(url: str, sysfs: Path = _SYSFS) -> float:
    """The longest that a reply may lie in the adapter of this port [s]."""
    file = latency_timer(url, sysfs)
    if file is not None:
        return read_latency_ms(file) * 1e-3
    if Path(url).name.startswith("rfcomm"):
        return BLUETOOTH_S
    return REMOTE_S if "://" in url and not url.startswith("fake://") else LOCAL_S
