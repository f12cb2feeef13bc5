"""Ctrl-C, SIGTERM and SIGHUP as a request that the stream sees between two samples.

A signal that raised wherever the program happens to be could land inside the path that cuts torque. So the handlers
only note the request, and stay in place until torque is off. A first signal brakes the arm, then cuts torque; a second
one cuts at once; more change nothing.
"""

import signal
from types import FrameType, TracebackType
from typing import Any

from hil.errors import StopRequested

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Context manager that catches the signals; `check` raises StopRequested after one came."""

    def __init__(self) -> None:
        self._received: signal.Signals | None = None
        self._count = 0
        self._former: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopRequest":
        for number in _SIGNALS:
            self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def check(self) -> None:
        if self._received is not None:
            name = "Ctrl-C" if self._received == signal.SIGINT else self._received.name
            raise StopRequested(f"Stopped by {name}.")

    @property
    def insisted(self) -> bool:
        """Whether a second signal came: no more braking then."""
        return self._count > 1

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._count += 1
        self._received = signal.Signals(number)
