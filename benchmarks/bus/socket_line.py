"""A fake arm in another process, connected by a Unix socket instead of a terminal.

The kernel forwards the bytes of a terminal in a thread of ordinary priority; on a machine that runs other programs,
they are therefore often milliseconds late. Bytes in a socket are available at once, and the reader is woken with its
own priority.
"""

import fcntl
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bus.served_pty import prioritise
from hil.drivers.port import DescriptorPort
from hil.fakes.description import load_fake
from hil.fakes.pty_server import PtyServer

ROOT = Path(__file__).parents[2]
DEVICE = "socket"
BAUD = 1_000_000
_SERVE = "import sys; from benchmarks.bus.socket_line import serve; serve(*sys.argv[1:])"


class SocketServer(PtyServer):
    """Serves an arm on a socket, as `hil fake --pty` serves one on a terminal."""

    def __init__(self, config: Path, descriptor: int) -> None:
        self._descriptor = descriptor
        super().__init__(load_fake(config))

    def _plug_in(self) -> None:
        self._master = self._descriptor
        os.set_blocking(self._master, False)


class Line:
    """The part of pyserial's port interface that `SocketPort` needs, implemented by a socket."""

    timeout = 0.0
    baudrate = BAUD

    def __init__(self, end: socket.socket) -> None:
        self.fileno, self.close = end.fileno, end.close

    @property
    def in_waiting(self) -> int:
        count: int = struct.unpack("i", fcntl.ioctl(self.fileno(), termios.FIONREAD, bytes(4)))[0]
        return count


class SocketPort(DescriptorPort):
    """A port that uses a socket in exactly the same way as a local device."""

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def discard_input(self) -> None:
        while select.select([self._descriptor], [], [], 0.0)[0]:
            os.read(self._descriptor, 4096)


@contextmanager
def socket_line(config: Path) -> Iterator[None]:
    """Serve this arm in another process, with real-time priority if permitted. In the `with` block, every port that a
    ServoBus opens is connected to this arm, whatever its name.
    """
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    command = [sys.executable, "-c", _SERVE, str(config), str(theirs.fileno())]
    with subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdout=subprocess.PIPE, cwd=ROOT) as process:
        theirs.close()
        prioritise(process.pid)
        assert process.stdout is not None
        process.stdout.readline()
        try:
            with patch("hil.drivers.bus.open_port", lambda *_: SocketPort(DEVICE, BAUD, Line(ours))):
                yield
        finally:
            process.terminate()
            ours.close()


def serve(config: str, descriptor: str) -> None:
    """Serve this arm on this end of a socket pair until SIGTERM."""
    server = SocketServer(Path(config), int(descriptor))
    signal.signal(signal.SIGTERM, lambda *_: server.stop())
    print("ready", flush=True)
    server.serve()
