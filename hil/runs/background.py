"""A separate thread for work that can block: writing to files and terminals, and callbacks.

A terminal stopped with Ctrl-S or a file on a disconnected network drive can block a write indefinitely, and Python
handles no signal in the meantime. Therefore the control loop only puts items into a bounded queue; items that do not
fit are dropped and counted.
"""

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

_Item = TypeVar("_Item")


class Background(Generic[_Item]):
    """Calls `act` with each item, in order, in a separate thread.

    most: maximum number of queued items. dropped: number of items dropped because the queue was full. failure: the
    first exception raised by `act`; later items are still processed.
    """

    def __init__(self, act: Callable[[_Item], None], most: int) -> None:
        self.dropped = 0
        self.failure: Exception | None = None
        self._act = act
        self._most = most
        self._queue: SimpleQueue[_Item | None] = SimpleQueue()
        self._now: _Item | None = None
        self._abandoned = False
        # A daemon thread: if it is blocked, the program can still end.
        self._thread = threading.Thread(target=self._run, name="hil background", daemon=True)
        self._thread.start()

    def put(self, item: _Item) -> None:
        """Queue an item, or drop it if the queue is full. Never blocks."""
        if self._queue.qsize() >= self._most:
            self.dropped += 1
        else:
            self._queue.put(item)

    def close(self, patience: float) -> list[_Item]:
        """Wait up to `patience` [s] for all items to be processed. Returns the unprocessed items in order."""
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
