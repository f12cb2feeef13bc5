"""What may block, done by a thread of its own: files, terminals, whoever watches.

Whoever has servos under torque must not wait for a disk or a terminal: a terminal stopped with Ctrl-S or a file behind
a hung network blocks a write without end, and Python acts on no signal meanwhile. So the control loop only puts into a
bounded queue, which never blocks; what does not fit is dropped and counted.
"""

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

_Item = TypeVar("_Item")


class Background(Generic[_Item]):
    """Calls `act` with each item in a thread of its own, in order. most: items that may wait.

    dropped: items that found the queue full. failure: the first exception that `act` raised; later items are tried all
    the same.
    """

    def __init__(self, act: Callable[[_Item], None], most: int) -> None:
        self.dropped = 0
        self.failure: Exception | None = None
        self._act = act
        self._most = most
        self._queue: SimpleQueue[_Item | None] = SimpleQueue()
        self._now: _Item | None = None
        self._abandoned = False
        # A daemon: what blocks it must not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name="hil background", daemon=True)
        self._thread.start()

    def put(self, item: _Item) -> None:
        """Hand over an item, or drop it where too many wait already. Never blocks."""
        if self._queue.qsize() >= self._most:
            self.dropped += 1
        else:
            self._queue.put(item)

    def close(self, patience: float) -> list[_Item]:
        """Wait at most `patience` [s] until everything is done; the items that were not, in order."""
        self._queue.put(None)
        self._thread.join(patience)
        if not self._thread.is_alive():
            return []
        self._abandoned = True
        left = [] if self._now is None else [self._now]
        while True:
            try:
                item = self._queue.get_nowait()
            except Empty:
                break
            if item is not None:
                left.append(item)
        self._queue.put(None)
        return left

    def _run(self) -> None:
        while (item := self._queue.get()) is not None and not self._abandoned:
            self._now = item
            try:
                self._act(item)
            except Exception as error:
                self.failure = self.failure or error
            self._now = None
