"""A port on a network, without pyserial's waits for the other end."""

import socket
from typing import Any

from hil.drivers.port.port import Port

_MOST_AT_ONCE = 4096
"""Maximum number of pending bytes that are read at once."""


class NetworkPort(Port):
    """A port on a network, `socket://` or `rfc2217://`. Reading never negotiates with the other end."""

    def __init__(self, url: str, baud: int, opened: Any) -> None:
        super().__init__(url, baud, opened)
        self._send_at_once()

    def reopen(self) -> bool:
        if is_back := super().reopen():
            self._send_at_once()
        return is_back

    def _send_at_once(self) -> None:
        # Otherwise TCP holds back the second of two writes until the first is acknowledged, for 40 ms.
        if line := getattr(self._serial, "_socket", None):
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _set_timeout(self, timeout: float) -> None:
        # pyserial's own setter configures the port again, which takes 50 ms with RFC 2217.
        self._serial._timeout = self._timeout = timeout

    def put_aside(self) -> None:
        self.overheard = self._read_once(_MOST_AT_ONCE, 0.0)  # `in_waiting` of a socket is never more than 1
        self.discard_input()

    def discard_input(self) -> None:
        # pyserial's own method waits for the other end with RFC 2217, and does not notice a closed connection.
        while self._read_once(_MOST_AT_ONCE, 0.0):
            pass
