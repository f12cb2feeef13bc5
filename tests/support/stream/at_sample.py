"""An action in the middle of a stream."""

from collections.abc import Callable
from typing import Any

from hil.experiment.stream import Progress, Watch


def at_sample(count: int, action: Callable[[], Any]) -> Watch:
    """A callback that calls `action` once, after `count` samples."""
    done: list[bool] = []

    def watch(progress: Progress) -> None:
        if progress.taken >= count and not done:
            done.append(True)
            action()

    return watch
