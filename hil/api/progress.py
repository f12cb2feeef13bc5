"""What a long call tells while it runs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from hil.experiment.stream import Progress as StreamProgress

__all__ = ["OnProgress", "Progress", "Stage"]

Stage = Literal["experiment", "estimation", "simulation", "check"]


@dataclass(frozen=True)
class Progress:
    """One report. Called about 20 times a second while the arm moves, and whenever there is something to say.

    stage: what the call is doing. message: a sentence for a person; empty while nothing new happened. stream: while the
    arm moves, the samples taken, the phase, and the latest state of every joint.
    """

    stage: Stage
    message: str = ""
    stream: StreamProgress | None = None

    @property
    def fraction(self) -> float | None:
        """Of the samples of this experiment, from 0 to 1; None outside one."""
        if self.stream is None:
            return None
        return self.stream.taken / max(1, self.stream.expected, self.stream.taken)


OnProgress = Callable[[Progress], None]


def ignore(_: Progress) -> None:
    """For a caller who does not listen."""
