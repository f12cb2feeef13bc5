"""Replacements for two classes of `dynamixel-sdk`: a port handler on top of an open `Port`, and a packet handler that
finds a reply despite noise before it.
"""

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS, Protocol2PacketHandler

from hil.drivers.packet import HEADER, MAX_LENGTH, NO_ID, Framer, Instruction, crc, unstuff
from hil.drivers.port import Port

PATIENCE_S = 0.018
"""How long set-up work initially waits for a reply beyond its wire time [s]; an EEPROM write takes a few ms."""

_SHORTEST = 11
"""Number of bytes of a status packet without data."""

_BEFORE_LENGTH, _FRONT = 7, 8
"""Number of bytes of a packet that LEN does not count, and number of bytes up to and including INST."""


class SdkPort:
    """Adapts an open `Port` to `dynamixel-sdk`, removing the echo of an adapter that receives its own transmissions.

    Unlike those of the SDK's own port, reads block instead of polling and use the port's clock. A failure cannot leave
    the port marked as in use, which would keep torque from being cut. The method names are the SDK's.
    """

    def __init__(self, port: Port) -> None:
        self._port = port
        self.patience = PATIENCE_S
        """How long to wait for a reply beyond its wire time [s]."""
        self._deadline = 0.0
        self._sent = b""
        """The last bytes written, kept as long as their echo may still arrive."""
        self._held = b""
        """Received bytes that may be the beginning of the echo."""

    @property
    def is_using(self) -> bool:
        return False

    @is_using.setter
    def is_using(self, value: bool) -> None:
        """Ignore the value: the SDK sets it around each exchange and leaves it set after an exception."""

    def getBaudRate(self) -> int:  # noqa: N802
        return self._port.baud

    def clearPort(self) -> None:  # noqa: N802
        self._held, port = b"", self._port
        if port.has_input():
            port.put_aside()
            self.hear(port.overheard)
            port.overheard = b""

    def hear(self, received: bytes) -> None:
        """Count late replies and other masters' instructions among bytes that are not part of the expected reply."""
        if received and not self._port.echoes:
            for packet in Framer().feed(received):
                self._port.late_replies += packet.is_status
                self._port.strangers += not packet.is_status

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
        # Twice the reply's wire time: the instruction that precedes the reply takes about as long.
        self._set_timeout(2 * self._port.wire_time(packet_length) + max(self.patience, self._port.latency + 2e-3))

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        self._set_timeout(msec / 1000)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._port.clock.now() >= self._deadline

    def _set_timeout(self, timeout: float) -> None:
        self._deadline = self._port.clock.now() + timeout


class ResyncingPacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's packet handler, made robust against noise before a reply.

    The SDK gives up when bytes that look like the beginning of a packet turn out not to be one. Here, the search
    continues after them until the timeout. `heard` is the ID of the last reply found, -1 after a reset.
    """

    heard = -1

    def rxPacket(self, port: SdkPort, _fast_option: bool) -> tuple[list[int], int]:  # noqa: N802
        received = b""
        while True:
            packet, missing = _first_status(received)
            if packet:
                port.hear(received.partition(packet)[0])
                self.heard = packet[4]
                payload = unstuff(packet[_BEFORE_LENGTH:-2])  # the SDK's own removeStuffing gets some data wrong
                size = (len(payload) + 2).to_bytes(2, "little")
                return [*packet[: _BEFORE_LENGTH - 2], *size, *payload, *packet[-2:]], COMM_SUCCESS
            more = port.readPort(missing)
            received += more
            if not more and port.isPacketTimeout():
                port.hear(received)
                return list(received), COMM_RX_CORRUPT if received else COMM_RX_TIMEOUT


def _first_status(received: bytes) -> tuple[bytes, int]:
    """Return the first intact status packet among the received bytes, and 0, since no more bytes need to be read.

    If there is no such packet, return b"" and the number of bytes to read next. This number does not reach beyond the
    incomplete packet, so that the next packet is not split.
    """
    missing = _SHORTEST - next(size for size in range(len(HEADER) - 1, -1, -1) if received.endswith(HEADER[:size]))
    at = received.find(HEADER)
    while at >= 0:
        front = received[at : at + _FRONT]
        if len(front) < _FRONT:
            missing = min(missing, _SHORTEST - len(front))
        elif front[4] not in NO_ID and front[-1] == Instruction.STATUS:
            end = at + _BEFORE_LENGTH + int.from_bytes(front[5:7], "little")
            packet = received[at:end]
            if at + _SHORTEST <= end <= at + MAX_LENGTH and end > len(received):
                missing = min(missing, end - len(received))
            elif len(packet) >= _SHORTEST and crc(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                return packet, 0
        at = received.find(HEADER, at + 1)
    return b"", missing
