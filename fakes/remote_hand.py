"""Socket access to the simulated hand that moves a fake arm served on a terminal by another process.

A request is the text `move ID:to=ANGLE,...`, `release ID` or `release`; the reply is empty, or the error message.
"""

import os
import socket
import tempfile
from contextlib import suppress
from pathlib import Path

from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.hand import parse_move
from hil.fakes.plants.errors import PlantError

_MOST_BYTES = 4096
_PATIENCE_S = 5.0


class NoHand(OSError):
    """No fake arm is served on this terminal. The message gives the terminal and the remedy."""


def socket_path(terminal: str) -> Path:
    """Return the path of the socket of a terminal served for this user."""
    name = terminal.strip("/").replace("/", "-")
    return Path(tempfile.gettempdir()) / f"hil-hand-{os.getuid()}-{name}"


class HandSocket:
    """The server's end of the socket. `fileno` becomes readable when a request arrives; `answer` then executes it."""

    def __init__(self, terminal: str) -> None:
        self.path = socket_path(terminal)
        self.path.unlink(missing_ok=True)  # left behind by a server that was killed
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.bind(str(self.path))
        self.path.chmod(0o600)

    def fileno(self) -> int:
        return self._socket.fileno()

    def answer(self, bus: FakeBus) -> None:
        """Execute the request and reply with the result."""
        with suppress(BlockingIOError):
            request, asker = self._socket.recvfrom(_MOST_BYTES)
            said = _do(request.decode("utf-8", "replace"), bus)
            with suppress(OSError):  # the client may be gone
                self._socket.sendto(said.encode(), asker)

    def close(self) -> None:
        """Remove the socket. May be called twice."""
        self._socket.close()
        self.path.unlink(missing_ok=True)


def ask_hand(device: Path | str, request: str) -> None:
    """Send a request to the simulated hand that moves the joints of a fake arm.

    device: path of the pseudo-terminal on which the arm is served, or a link to it.

    Raises NoHand if no arm is served there, ValueError for an invalid request.
    """
    served = socket_path(str(Path(device).resolve()))
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking,
    ):
        asking.settimeout(_PATIENCE_S)
        asking.bind(str(Path(folder) / "reply"))
        try:
            asking.sendto(request.encode(), str(served))
            said = asking.recv(_MOST_BYTES).decode()
        except OSError as error:
            raise NoHand(f"{device}: no fake arm is served here; start one with hil fake ARM --pty") from error
    if said:
        raise ValueError(said)


def _do(request: str, bus: FakeBus) -> str:
    verb, _, rest = request.partition(" ")
    try:
        if verb == "move":
            bus.hand.move(*[parse_move(text) for text in rest.split()])
        elif verb == "release":
            bus.hand.release(int(rest) if rest else None)
        else:
            return f'"{verb}" is neither move nor release'
    except (ValueError, PlantError) as error:
        return str(error)
    return ""
