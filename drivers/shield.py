"""Critical sections: signals that arrive inside are delivered afterwards.

Ctrl-C raises KeyboardInterrupt wherever the program happens to be, even between two servos while torque is being cut. A
program that uses the driver as a library has no signal handlers that merely set a flag, so the driver itself holds
signals back for the few milliseconds in which torque is cut.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Hold back SIGINT, SIGTERM and SIGHUP in the block; each kind that arrived is raised once afterwards.

    Only the main thread receives signals; in any other thread this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if number not in came:
            came.append(number)

    # None is a handler that was not installed from Python: it could not be restored, so it is left alone.
    former = {number: handler for number in _SIGNALS if (handler := signal.getsignal(number)) is not None}
    try:
        for number in former:
            signal.signal(number, note)
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
        for late in came:
            signal.raise_signal(late)
