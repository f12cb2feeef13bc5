"""Properties of local serial devices that pyserial does not provide: other users, actual baud rate, adapter name."""

import fcntl
import os
import termios
from contextlib import suppress
from pathlib import Path
from struct import Struct

_TCGETS2 = 0x802C542A
_SPEEDS = Struct("36x2I")  # input and output rate, the end of `struct termios2`
_PROC, _SYSFS = Path("/proc"), Path("/sys")
_USB_PORTS = ("ttyUSB*", "ttyACM*")


def is_pseudo_terminal(device: str) -> bool:
    """Whether the device is a pty. The program that serves its other end may legitimately keep this end open, too."""
    return Path(device).resolve().parent == Path("/dev/pts")


def keep_others_out(descriptor: int) -> None:
    """Make the system refuse any further attempt to open this device, except by root.

    pyserial's `exclusive` is an advisory lock, which DYNAMIXEL SDK and Wizard do not check.
    """
    with suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCEXCL)


def other_users(device: str, proc: Path = _PROC) -> list[str]:
    """Return the other programs that have this device open and are visible to this user, as "NAME (PID 12)"."""
    wanted, found = os.path.realpath(device), []
    for process in proc.glob("[0-9]*"):
        with suppress(OSError):
            if process.name != str(os.getpid()) and any(_leads_to(each, wanted) for each in process.glob("fd/*")):
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
                found.append(f"{name} (PID {process.name})")
    return sorted(found)


def _leads_to(link: Path, wanted: str) -> bool:
    with suppress(OSError):
        return os.readlink(link) == wanted  # noqa: PTH115  # half the time of Path.readlink
    return False


def true_baud(descriptor: int) -> int | None:
    """Return the baud rate at which the driver runs the device; None if the system does not report it.

    If the adapter does not support a requested rate, its driver reports no error but sets a different rate.
    """
    speeds = bytearray(_SPEEDS.size)
    try:
        fcntl.ioctl(descriptor, _TCGETS2, speeds)
    except OSError:
        return None
    return int(_SPEEDS.unpack(speeds)[1])


def adapter_name(device: str, sysfs: Path = _SYSFS) -> str:
    """Return a name for a device's USB adapter that, unlike the device path, stays the same after replugging.

    Returns "" if the adapter has no serial number, or if another connected adapter has the same number.
    """
    if "://" in device:
        return ""
    own = Path(device).resolve().name
    ports = sysfs / "class" / "tty"
    name = _identity(ports / own / "device")
    others = (each for pattern in _USB_PORTS for each in ports.glob(pattern) if each.name != own)
    return "" if any(name and _identity(each / "device") == name for each in others) else name


def device_of(name: str, sysfs: Path = _SYSFS) -> str | None:
    """Return the current device path of the adapter with this persistent name; None if it is not plugged in."""
    ports = sysfs / "class" / "tty"
    found = [each for pattern in _USB_PORTS for each in ports.glob(pattern) if _identity(each / "device") == name]
    return f"/dev/{found[0].name}" if name and len(found) == 1 else None


def _identity(device: Path) -> str:
    """Vendor, product, serial number and interface of a USB device in sysfs; "" if any of them is missing."""
    place = device.resolve()
    with suppress(OSError, StopIteration):
        interface = next(each for each in (place, *place.parents) if (each / "bInterfaceNumber").is_file())
        usb = next(each for each in interface.parents if (each / "idVendor").is_file())
        files = (usb / "idVendor", usb / "idProduct", usb / "serial", interface / "bInterfaceNumber")
        return "-".join(["usb", *(file.read_text(encoding="utf-8").strip() for file in files)])
    return ""
