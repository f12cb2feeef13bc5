"""Handle a closed pipe, a full disk or a stopped terminal on standard output. Results are saved before printing."""

import errno
import io
import os
import select
import signal
import stat
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

PATIENCE_S = 3.0
"""Time after a signal within which a terminal or pipe must accept some output [s]; otherwise the rest is discarded."""

_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask the program to end."""

_UNHANDLED = (signal.SIG_DFL, signal.SIG_IGN, signal.default_int_handler)

_PIECE, _POLL_S = 256, 0.1
"""Bytes per write (few, so that no write blocks for long), and interval between attempts to write [s]."""


def require_output() -> None:
    """Exit if standard output is closed (`>&-`); otherwise the next file opened would take its place."""
    if sys.stdout is None:
        print("hil: standard output is closed. Redirect it, for example to /dev/null.", file=sys.stderr)
        sys.exit(1)


@contextmanager
def readable_output() -> Iterator[None]:
    """Treat a closed pipe (`| head -1`) as success; report a full disk as a failure."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
        sys.exit(0)
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _drop_output()
        said = "hil: cannot write to standard output: no space left. Finished results are in their folder."
        print(said, file=sys.stderr)
        sys.exit(1)


@contextmanager
def bounded_output() -> Iterator[None]:
    """Let the program end after a signal even if its terminal is stopped (Ctrl-S) or nobody reads its output.

    Until a signal arrives, output waits indefinitely. Only terminals and pipes are handled in this way, and only in
    the main thread; the files of a run folder are completed and closed regardless. If output had to be discarded, the
    exit code is that of the signal: 128 plus its number.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, told = os.pipe()
    for end in (heard, told):
        os.set_blocking(end, False)
    former = signal.set_wakeup_fd(told, warn_on_full_buffer=False)
    streams = sys.stdout, sys.stderr
    patience = _Patience(heard)
    try:
        sys.stdout, sys.stderr = (_bounded(stream, patience) for stream in streams)
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        sys.stdout, sys.stderr = streams
        signal.set_wakeup_fd(former)
        os.close(heard)
        os.close(told)
        if patience.has_discarded and patience.signal is not None:
            sys.exit(128 + patience.signal)


def _bounded(stream: Any, patience: "_Patience") -> Any:
    """Return a stream that writes to the same terminal or pipe but waits at most `patience`. Other streams are returned
    unchanged.
    """
    try:
        number = stream.fileno()
        mode = os.fstat(number).st_mode
    except (AttributeError, OSError, ValueError):
        return stream
    if not (stat.S_ISFIFO(mode) or os.isatty(number)):
        return stream
    stream.flush()
    raw = io.BufferedWriter(_Bounded(number, patience))
    return io.TextIOWrapper(raw, stream.encoding, stream.errors, line_buffering=stream.line_buffering)


class _Patience:
    """How long output waits for its reader: indefinitely until a signal arrives, `PATIENCE_S` from then on.

    heard: non-blocking file descriptor that delivers the number of each arriving signal as one byte.
    """

    def __init__(self, heard: int) -> None:
        self._heard = heard
        self._since: float | None = None
        """Time of the signal or of the last write after it [s]; None until a signal arrives."""
        self.signal: int | None = None
        """The first signal that asked the program to end."""
        self.has_discarded = False

    def is_over(self) -> bool:
        """Whether output that cannot be written now is discarded."""
        if self._since is None and self._has_heard():
            self._since = time.monotonic()
        return self._since is not None and time.monotonic() - self._since >= PATIENCE_S

    def _has_heard(self) -> bool:
        with suppress(BlockingIOError):
            numbers = os.read(self._heard, _PIECE)
            self.signal = next((each for each in numbers if each in _STOPPING), None)
        return self.signal is not None

    @contextmanager
    def listening(self) -> Iterator[None]:
        """While output waits, let a signal that nothing else handles end the wait instead of the program.

        This applies even to a signal that was ignored when the program started, such as Ctrl-C in a shell's background
        jobs, since only output is lost. An ignored SIGHUP (nohup) remains ignored.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        former = {each: signal.getsignal(each) for each in _STOPPING}
        taken = [each for each, handler in former.items() if handler in _UNHANDLED]
        if former[signal.SIGHUP] is signal.SIG_IGN:
            taken.remove(signal.SIGHUP)
        try:
            for each in taken:
                signal.signal(each, lambda *_: None)  # Python writes its number to `heard`
            yield
        finally:
            for each in taken:
                signal.signal(each, former[each])

    def made_progress(self) -> None:
        """Restart the wait."""
        if self._since is not None:
            self._since = time.monotonic()


class _Bounded(io.RawIOBase):
    """Writes to a terminal or pipe in pieces that do not block, and discards the output once `patience` is over."""

    def __init__(self, number: int, patience: _Patience) -> None:
        super().__init__()
        self._number = number
        self._patience = patience

    def fileno(self) -> int:
        return self._number

    def isatty(self) -> bool:
        return os.isatty(self._number)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        if self._patience.has_discarded:  # writing more would leave a gap
            return len(data)
        if not self._is_ready(0.0):
            with self._patience.listening():
                while not self._is_ready(_POLL_S):
                    if self._patience.is_over():
                        self._patience.has_discarded = True
                        return len(data)
        written = os.write(self._number, data[:_PIECE])
        self._patience.made_progress()
        return written

    def _is_ready(self, seconds: float) -> bool:
        """Wait at most this time [s] until a piece can be written without blocking; return whether it can."""
        return bool(select.select([], [self._number], [], seconds)[1])


def _drop_output() -> None:
    """Discard buffered output; otherwise Python would try to write it again at exit and report an error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
