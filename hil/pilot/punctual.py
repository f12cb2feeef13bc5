"""Repeat runs that were stopped because this computer missed deadlines. Such stops reveal nothing about the arm."""

from collections.abc import Callable

from hil.config.schema import Config
from hil.errors import Cause, SafetyStop
from hil.runs.run_folder import RunFolder

MOST_REPEATS = 3


def punctual(play: Callable[[], str], config: Config, folder: RunFolder, name: str, say: Callable[[str], None]) -> str:
    """Call `play` and return its result; if deadlines were missed, call it again, up to MOST_REPEATS times.

    The recording of a stopped run is set aside in `folder`. Raises the same errors as `play`.
    """
    for number in range(1, MOST_REPEATS + 1):
        try:
            return play()
        except SafetyStop as stopped:
            if stopped.cause is not Cause.LATE:
                raise
            torque = " ".join(getattr(stopped, "__notes__", []))
            say(f"{name} ended early: {stopped} {torque}\nRepeating it (repeat {number} of at most {MOST_REPEATS}).")
            folder.set_aside(f"late-{number}", config)
    return play()
