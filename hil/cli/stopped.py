"""Handle Ctrl-C, SIGTERM and SIGHUP while no arm moves: print a message and the next command; exit with 128 plus the
signal number.

While an arm may move, hil.experiment.stop_request handles these signals; the exit codes are the same.
"""

import _thread
import errno
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import typer

from hil.cli.errors import handled_behind
from hil.next_step import next_step

_CLOSED = frozenset({errno.EIO, errno.EPIPE})
"""Errors of a terminal that has been closed."""

_LOADERS, _LATER_S = frozenset({"importlib", "_frozen_importlib", "numba", "llvmlite"}), 0.02
"""Packages whose code a signal must not interrupt: a signal that arrives there is sent again after this time [s]."""


class Terminated(KeyboardInterrupt):
    """Raised on Ctrl-C, SIGTERM or SIGHUP, so that everything is cleaned up in the same way."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Turn a signal that arrives in the block into a message and an exit code."""
    former = _catch() if threading.current_thread() is threading.main_thread() else {}
    try:
        yield
    except (KeyboardInterrupt, OSError) as raised:
        if (stopped := _interruption(raised)) is None:
            raise
        number = stopped.number if isinstance(stopped, Terminated) else signal.SIGINT
        name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        with suppress(OSError):  # a closed terminal
            print("\n".join([f"hil: Stopped by {name}.", *how_to_go_on(stopped)]), file=sys.stderr)
        raise typer.Exit(128 + number) from None
    finally:
        for each, handler in former.items():
            signal.signal(each, handler)


def _interruption(raised: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that was raised or that was being handled when `raised` was; None if there was none.

    A terminal that is closed sends SIGHUP and then rejects all output, for example the end of a progress bar.
    """
    if isinstance(raised, OSError) and raised.errno not in _CLOSED:
        return None
    return handled_behind(raised, KeyboardInterrupt)


def how_to_go_on(stopped: BaseException) -> list[str]:
    """Return the notes attached to an interruption, and the command to type next."""
    return [*getattr(stopped, "__notes__", []), *same_again(stopped)]


def same_again(stopped: BaseException) -> list[str]:
    """Return a list with one line that suggests repeating the command; empty if the notes attached to the
    interruption name a next command.
    """
    notes = getattr(stopped, "__notes__", [])
    return [] if any("hil " in note for note in notes) else [next_step(*sys.argv[1:])]


def _catch() -> dict[signal.Signals, Any]:
    """Catch the three signals, except those that are already handled, and SIGHUP if it is ignored (nohup).

    A background job of a script inherits SIGINT as ignored, but whoever sends it asks for a stop, which must not be
    lost before the arm moves.
    """
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    free = (signal.SIG_DFL, signal.default_int_handler)
    caught = [
        each
        for each in signals
        if signal.getsignal(each) in (free if each is signal.SIGHUP else (*free, signal.SIG_IGN))
    ]
    return {each: signal.signal(each, _raise) for each in caught}


def _raise(number: int, frame: FrameType | None) -> None:
    """Raise Terminated, but not while modules are being loaded.

    Python ignores exceptions in callbacks of compiled modules that are being loaded: the signal would have no effect.
    """
    inner = frame
    while inner is not None:
        if inner.f_globals.get("__name__", "").partition(".")[0] in _LOADERS:
            threading.Timer(_LATER_S, _thread.interrupt_main, [number]).start()
            return
        inner = inner.f_back
    raise Terminated(number)
