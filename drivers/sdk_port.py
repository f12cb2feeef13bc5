"""The port on which the packet handler of `dynamixel-sdk` works, in place of the SDK's own PortHandler."""

from hil.drivers.port import Port

PATIENCE_S = 0.018
"""Time that set-up work waits for a reply beyond its wire time [s]; an EEPROM write takes a few ms."""


class SdkPort:
    """Adapts our open port to `dynamixel-sdk`, removing the echo of an adapter that receives its own transmissions.

    Unlike with the SDK's own port, reads block instead of polling, and time is the port's clock. A failure cannot leave
    the port marked as in use, which would make it impossible to cut torque. The method names are the SDK's.
    """

    def __init__(self, port: Port) -> None:
        self._port = port
        self._deadline = 0.0
        self._sent = b""
        """The bytes written last, kept as long as their echo may still arrive."""
        self._held = b""
        """Bytes received that may be the beginning of the echo."""

    @property
    def is_using(self) -> bool:
        return False

    @is_using.setter
    def is_using(self, value: bool) -> None:
        """Ignore the value: the SDK sets it around each exchange and leaves it set after an exception."""

    def getBaudRate(self) -> int:  # noqa: N802
        return self._port.baud

    def clearPort(self) -> None:  # noqa: N802
        self._held = b""
        self._port.discard_input()

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self._sent, self._held = bytes(packet), b""
        self._port.write(self._sent)
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        while self._sent and self._sent.startswith(self._held):
            # A status packet and the instruction it answers begin alike and differ at the eighth byte.
            if self._held == self._sent:
                self._port.echoes = True
                self._sent = self._held = b""
                break
            more = self._port.read(min(8, len(self._sent) - len(self._held)), self._remaining)
            self._held += more
            if not more:
                return b""
        self._sent = b""
        taken, self._held = self._held[:length], self._held[length:]
        return taken + self._port.read(length - len(taken), self._remaining) if len(taken) < length else taken

    @property
    def _remaining(self) -> float:
        return max(0.0, self._deadline - self._port.clock.now())

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        # Twice the reply's wire time: once for the instruction before it, once for the reply.
        self._set_timeout(2 * self._port.wire_time(packet_length) + max(PATIENCE_S, self._port.latency + 2e-3))

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        self._set_timeout(msec / 1000)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._port.clock.now() >= self._deadline

    def _set_timeout(self, timeout: float) -> None:
        self._deadline = self._port.clock.now() + timeout
