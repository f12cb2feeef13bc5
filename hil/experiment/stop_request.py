"""Treat Ctrl-C, SIGTERM and SIGHUP as requests that are handled between two samples and never lost.

An exception raised by a signal handler could interrupt the code that cuts torque. Therefore, while a servo may have
torque, the handlers only record the request, and the stream checks for it between two samples. The first signal brakes
the arm, then cuts torque; a second one cuts torque at once; further ones have no effect. While no servo has torque, a
signal ends the program at once.

A request stays in effect until the outermost block ends: even if the exception is swallowed, no further experiment
starts.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, ClassVar

from hil.errors import StopRequested

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Context manager that catches the signals; `check` raises StopRequested after a signal.

    A block inside another one in the same thread shares the outer one's request. Only the main thread receives signals;
    other threads never see a request.
    """

    _outermost: ClassVar["StopRequest | None"] = None

    def __init__(self) -> None:
        self._received: signal.Signals | None = None
        self._count = 0
        self._armed = 0
        self._former: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is not threading.main_thread():
            return self
        if StopRequest._outermost is not None:
            return StopRequest._outermost
        StopRequest._outermost = self
        for number in _SIGNALS:
            self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if StopRequest._outermost is not self:
            return
        for number, handler in self._former.items():
            signal.signal(number, handler)
        StopRequest._outermost = None
        if kind is None:
            self.check()

    @contextmanager
    def only_noted(self) -> Iterator[None]:
        """Record signals without raising an exception while the block runs and servos may have torque."""
        self.check()
        self._armed += 1
        try:
            yield
        finally:
            self._armed -= 1

    def check(self) -> None:
        if self._received is not None:
            raise self._stop()

    @property
    def insisted(self) -> bool:
        """Whether a second signal arrived, which ends braking."""
        return self._count > 1

    def check_again(self, asked: int) -> None:
        """Raise StopRequested if more than `asked` signals have arrived."""
        if self._count > asked:
            raise self._stop()

    @property
    def count(self) -> int:
        return self._count

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._count += 1
        self._received = signal.Signals(number)
        if not self._armed:
            raise self._stop()

    def _stop(self) -> StopRequested:
        assert self._received is not None
        name = "Ctrl-C" if self._received == signal.SIGINT else self._received.name
        return StopRequested(f"Stopped by {name}.", number=self._received)
