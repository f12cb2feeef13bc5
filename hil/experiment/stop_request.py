"""Ctrl-C, SIGTERM and SIGHUP as a request that is honoured between two samples and never lost.

A signal that raised wherever the program happens to be could land inside the path that cuts torque. So while a servo
may have torque the handlers only note the request; the stream checks it between two samples. A first signal brakes the
arm, then cuts torque; a second one cuts at once; more change nothing. While no servo has torque a signal ends the
program at once.

A request holds until the outermost block is left: what came while torque was being cut stops the steps of a pilot that
would have followed, and whatever swallowed the exception, no further experiment starts.
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
    """Context manager that catches the signals; `check` raises StopRequested after one came.

    A block inside another one of the same thread shares the outer one's request. In a thread that is not the main one,
    which gets no signals, there is never a request.
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
        """Inside the block, where servos may have torque, a signal raises nothing by itself."""
        self.check()
        self._armed += 1
        try:
            yield
        finally:
            self._armed -= 1

    def check(self) -> None:
        if self._received is not None:
            raise StopRequested(self._said())

    @property
    def insisted(self) -> bool:
        """Whether a second signal came: then braking ends."""
        return self._count > 1

    @property
    def count(self) -> int:
        """How many signals came."""
        return self._count

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._count += 1
        self._received = signal.Signals(number)
        if not self._armed:
            raise StopRequested(self._said())

    def _said(self) -> str:
        assert self._received is not None
        name = "Ctrl-C" if self._received == signal.SIGINT else self._received.name
        return f"Stopped by {name}."
