"""A pty with responder.c at its far end."""

import os
import shutil
import subprocess
import sys
import tempfile
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hil.setup.realtime import PRIORITY

SOURCE = Path(__file__).with_name("responder.c")


def prioritise(process: int) -> None:
    """Give a process priority over ordinary programs, and the first core, if that is permitted."""
    with suppress(OSError):
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setaffinity(process, {min(os.sched_getaffinity(0))})


@contextmanager
def responder_binary() -> Iterator[Path]:
    """Compile responder.c into a temporary folder."""
    compiler = shutil.which("cc")
    if compiler is None:
        sys.exit("The benchmark needs a C compiler called cc (Debian: apt install gcc).")
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "responder"
        subprocess.run([compiler, "-O2", "-o", binary, SOURCE], check=True)
        yield binary


@contextmanager
def served_pty(binary: Path, byte_ns: int, *, real_time: bool = False) -> Iterator[str]:
    """Open a pty with the responder at its far end; yield its name.

    byte_ns: wire time per byte [ns]. real_time: whether to give the responder priority over ordinary programs.
    """
    master, slave = os.openpty()
    tty.setraw(slave)
    server = subprocess.Popen([binary, "serve", str(master), str(byte_ns)], pass_fds=[master])
    os.close(master)
    if real_time:
        prioritise(server.pid)
    try:
        # Keep the slave open here, so that the responder survives a client that closes its own.
        yield os.ttyname(slave)
    finally:
        os.close(slave)
        server.terminate()
        server.wait()
