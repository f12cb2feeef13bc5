"""Progress reports of long-running functions."""

import _thread
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from hil.errors import StopRequested
from hil.experiment.stream import Progress as StreamProgress

__all__ = ["OnProgress", "Progress", "Stage"]

log = logging.getLogger(__name__)

Stage = Literal["experiment", "estimation", "simulation", "check"]


@dataclass(frozen=True)
class Progress:
    """One progress report, sent about 20 times a second while the arm moves, and whenever there is a message.

    stage: what the call is doing. message: a sentence for the user; empty if there is nothing new to say. stream: while
    the arm moves, the number of samples taken, the phase, and the latest state of every joint.
    """

    stage: Stage
    message: str = ""
    stream: StreamProgress | None = None

    @property
    def fraction(self) -> float | None:
        """Fraction of this experiment's samples taken so far, from 0 to 1; None when no experiment is running."""
        if self.stream is None:
            return None
        return self.stream.taken / max(1, self.stream.expected, self.stream.taken)


OnProgress = Callable[[Progress], None]


def forgiving(listener: OnProgress) -> OnProgress:
    """Wrap a callback so that it is not called again after its first exception, which is logged.

    A StopRequested or KeyboardInterrupt raised during the callback (Ctrl-C, for example) does not count as a failure of
    the callback and is passed on.
    """
    if not callable(listener):
        raise TypeError(f"on_progress must be a function that takes one Progress, not {listener!r}.")
    owner, failed = threading.current_thread(), False

    def tell(progress: Progress) -> None:
        nonlocal failed
        if failed:
            return
        try:
            listener(progress)
        except StopRequested:
            raise
        except KeyboardInterrupt:
            if threading.current_thread() is owner:
                raise
            failed = True
            _thread.interrupt_main()
        except (Exception, SystemExit):
            failed = True
            log.exception("on_progress raised an exception; it will not be called again")

    return tell


def ignore(_: Progress) -> None:
    """Ignore a progress report."""
