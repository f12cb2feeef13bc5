"""The events of a run. A separate thread writes them, so that a slow disk cannot delay the control loop."""

import json
import os
from contextlib import suppress
from pathlib import Path

from hil.runs.background import Background
from hil.runs.run_folder import RunFolder

MOST_WAITING = 1000
PATIENCE_S = 0.5
"""Longest time that a finished run waits, with torque off, for its events to be written [s]."""

LATE_NAME = "events-late.jsonl"


class EventLog:
    """Events of one run.

    On exit, the log waits briefly for all events to be written. If events.jsonl blocks, the events that could not be
    written in time go to events-late.jsonl.
    """

    def __init__(self, run: RunFolder) -> None:
        self._late_path = run.path / LATE_NAME
        self._written: Background[tuple[float, str]] = Background(lambda event: run.event(*event), MOST_WAITING)

    def __enter__(self) -> "EventLog":
        return self

    def __exit__(self, *_: object) -> None:
        dropped = self._written.dropped
        left = self._written.close(PATIENCE_S)
        if dropped:
            left.append((left[-1][0] if left else 0.0, f"{dropped} events were dropped: the disk could not keep up"))
        if left:
            _write_without_waiting(self._late_path, left)

    def note(self, time: float, what: str) -> None:
        """Queue an event with its time on the port's clock [s]. Never blocks, never raises."""
        self._written.put((time, what))

    @property
    def failure(self) -> Exception | None:
        """Exception that kept events from being written, or None."""
        return self._written.failure


def _write_without_waiting(path: Path, events: list[tuple[float, str]]) -> None:
    text = "".join(
        json.dumps({"time": round(time, 6), "event": what}, ensure_ascii=False) + "\n" for time, what in events
    )
    with suppress(OSError):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o644)
        try:
            os.write(descriptor, text.encode())
        finally:
            os.close(descriptor)
