"""Processes that do what `python -m ...` does, forked from a server that has already imported what they need.

A new interpreter takes 0.5 to 1.2 s of processor time to import numpy, scipy, numba and hil, and most tests of signals,
terminals and kills need a process but not that. What follows the fork is as in a new interpreter: arguments,
environment, folder, standard streams, signal handlers and the end of the process, from `atexit` to the exit code. What
an interpreter reads while it starts, or a module while it is imported (PYTHONPATH for hil itself, the number of BLAS
threads, NUMBA_*), is the server's. So tests of such things start a real process, and so does at least one test of each
kind of process.
"""

import atexit
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from threading import Lock
from typing import IO, Any, Self

from tests.support.paths import ROOT
from tests.support.processes.server import CODE, MOST_BYTES

__all__ = ["CODE", "Process", "run", "start"]

IMPORTED = (
    *("scipy.fft", "scipy.ndimage", "rich.live", "serial.urlhandler.protocol_loop"),
    *("hil.cli.app", "hil.cli.terminal", "hil.api.check", "hil.api.experiment", "hil.cli.views.live_view"),
    *("hil.cli.views.result_table", "hil.cli.views.setup_view", "hil.setup.scan", "hil.setup.preflight"),
    *("hil.experiment.run", "hil.estimation.settled_estimate", "hil.estimation.after_a_stop", "hil.report.page"),
    *("hil.dry_run.prediction", "hil.estimation.changes.diff", "hil.export.formats", "hil.drivers.adapter.latency"),
    *("hil.fakes.pty_server", "hil.fakes.remote_hand", "hil.fakes.protocol_fake"),
)
"""Where the commands that the tests start do their work."""

STARTS_S = 120.0


class Server:
    """A process that forks others from itself."""

    def __init__(self, modules: Sequence[str]) -> None:
        ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its:
            its.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * MOST_BYTES)
            words = [sys.executable, "-m", "tests.support.processes.server", str(its.fileno()), *modules]
            one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
            self._process = subprocess.Popen(
                words, cwd=ROOT, env=os.environ | one, stdin=subprocess.DEVNULL, pass_fds=[its.fileno()]
            )
        ours.settimeout(STARTS_S)
        self._control, self._lock = ours, Lock()
        assert ours.recv(16) == b"ready", "the server of processes did not start"

    def ask(self, request: dict[str, Any], descriptors: Sequence[int] = ()) -> Any:
        with self._lock:
            socket.send_fds(self._control, [json.dumps(request).encode()], descriptors)
            return json.loads(self._control.recv(MOST_BYTES))

    def end(self) -> None:
        self._control.close()
        self._process.wait()


@cache
def _server() -> Server:
    server = Server(IMPORTED)
    atexit.register(server.end)
    return server


class Process:
    """A forked process, used like a `subprocess.Popen`. returncode: None while it is not known to have ended."""

    def __init__(
        self,
        words: Sequence[str],
        *,
        stdin: Any = None,
        stdout: Any = None,
        stderr: Any = None,
        cwd: Path | str | None = None,
        env: Mapping[str, str] | None = None,
        text: bool = False,
        start_new_session: bool = False,
    ) -> None:
        self.args = list(words)
        self.returncode: int | None = None
        self._text = text
        request = {
            "words": self.args,
            "folder": str(cwd or Path.cwd()),
            "environment": dict(os.environ if env is None else env),
            "session": start_new_session,
        }
        with ExitStack() as theirs:
            source, _ = self._end(theirs, stdin, 0)
            out, self.stdout = self._end(theirs, stdout, 1)
            err, self.stderr = (out, None) if stderr == subprocess.STDOUT else self._end(theirs, stderr, 2)
            self.pid: int = _server().ask(request, [source, out, err])
        self._ended = os.pidfd_open(self.pid)

    def _end(self, theirs: ExitStack, wanted: Any, number: int) -> tuple[int, IO[Any] | None]:
        """The descriptor for the process, and for a pipe from it the stream that reads it."""
        if wanted is None:
            return number, None
        if wanted == subprocess.DEVNULL:
            return theirs.enter_context(Path(os.devnull).open("r+b", buffering=0)).fileno(), None
        if wanted == subprocess.PIPE:
            assert number, "nothing writes to these processes"
            read, write = os.pipe()
            theirs.callback(os.close, write)
            return write, os.fdopen(read, "r" if self._text else "rb")
        return wanted if isinstance(wanted, int) else wanted.fileno(), None

    def poll(self) -> int | None:
        if self.returncode is None:
            self.returncode = _server().ask({"reap": self.pid})
            if self.returncode is not None:
                os.close(self._ended)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            ready, _, _ = select.select([self._ended], [], [], timeout)
            if not ready or self.poll() is None:
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        assert self.returncode is not None
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[Any, Any]:
        """Read both pipes until the process has ended; kill it if that takes longer than `timeout` [s]."""
        with ThreadPoolExecutor(2) as pool:
            said = [pool.submit(each.read) if each is not None else None for each in (self.stdout, self.stderr)]
            try:
                self.wait(timeout)
            except subprocess.TimeoutExpired:
                self.kill()
                raise
        out, err = (each.result() if each is not None else None for each in said)
        return out, err

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for each in (self.stdout, self.stderr):
            if each is not None:
                each.close()
        self.wait()


def start(words: Sequence[str], **options: Any) -> "Process | subprocess.Popen[Any]":
    """Start what `python -m` starts with these words, or what `python -c` starts with those after `CODE`.

    options: as those of `subprocess.Popen`, as far as `Process` has them. Where the system cannot wait for a process of
    another parent, it is a new interpreter.
    """
    if hasattr(os, "pidfd_open"):
        return Process(words, **options)
    return subprocess.Popen([sys.executable, *([] if words[0] == CODE else ["-m"]), *words], **options)


def run(
    words: Sequence[str], *, timeout: float | None = None, capture_output: bool = False, **options: Any
) -> "subprocess.CompletedProcess[Any]":
    """As `start`, and wait for the end; a process that takes longer than `timeout` [s] is killed."""
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with start(words, **options) as process:
        out, err = process.communicate(timeout)
        return subprocess.CompletedProcess(process.args, process.wait(), out, err)
