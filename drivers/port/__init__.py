"""Serial ports that cannot hang: any pyserial URL, bounded reads, and PortLost when the cable is unplugged.

Open one with `open_port`. `Port` does its I/O through pyserial and so supports every URL that pyserial does;
`NetworkPort` avoids pyserial's waits on a network; `DescriptorPort` reads and writes a local device directly, which
halves the cost per cycle.
"""

import serial

from hil.drivers.port.descriptor_port import DescriptorPort
from hil.drivers.port.network_port import NetworkPort
from hil.drivers.port.opening import open_serial
from hil.drivers.port.port import GROWTH, Port, ReplyTime

__all__ = ["GROWTH", "DescriptorPort", "NetworkPort", "Port", "ReplyTime", "open_port"]


def open_port(url: str, baud: int) -> Port:
    """Open a device or pyserial URL. Raises PortNotOpened; its message gives the reason and the remedy."""
    line = open_serial(url, baud)
    if hasattr(line, "_socket"):
        return NetworkPort(url, baud, line)
    if type(line) is not serial.Serial:
        return Port(url, baud, line)
    return DescriptorPort(url, baud, line)
