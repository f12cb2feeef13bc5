"""Missed deadlines: how long the arm may go without a command, and what fraction of the deadlines may be missed."""

from collections.abc import Callable
from math import inf

from hil.config.schema import Config
from hil.errors import Cause, SafetyStop
from hil.plan.silence import late_limit

LATE_SHARE = 0.2
"""Fraction of deadlines that may be missed in the long run."""

_OFTEN_LATE = 5.0
_OF_ONE_STALL = 2  # number of deadlines counted per stall

_WHY_LATE = (
    "This program was stopped (Ctrl-Z, SIGSTOP, a debugger), the computer was suspended, or other programs kept it "
    "busy: close those programs, or lower experiment.rate."
)


class Deadlines:
    """Counts the samples' missed deadlines. Every method may raise SafetyStop.

    heard_instead: returns a message about what arrived instead of replies, with advice; "" if nothing did. any_share:
    whether to ignore the fraction of missed deadlines: while an arm is being lowered, only the time without a command
    matters.
    """

    def __init__(self, config: Config, heard_instead: Callable[[], str] = str, *, any_share: bool = False) -> None:
        self._interval = 1.0 / config.experiment.rate
        self._watchdog = config.safety.watchdog
        self._limit = late_limit(config)
        self._most_often = inf if any_share else max(_OFTEN_LATE, 0.5 * self._limit.seconds / self._interval)
        self._in_a_row = 0
        self._often = 0.0
        self._heard_instead = heard_instead
        self._counted = self._waited = 0
        """Number of missed deadlines that `_often` reflects, and how many of these were missed while this program
        waited for a reply that never came.
        """
        self.any_missed = False
        """Whether a deadline was missed and too few have been met since then to offset this."""

    def missed(self, seconds: float = 0.0, *, waited: bool = False) -> None:
        """Record a missed deadline, `seconds` after the last command.

        waited: whether this program was waiting for a reply that was lost or damaged.
        """
        self.any_missed = True
        self._counted += 1
        self._waited += waited
        self._in_a_row += 1
        if self._in_a_row <= _OF_ONE_STALL:
            self._often += 1.0
        seconds = max(seconds, self._in_a_row * self._interval)
        allowed, said = self._limit
        if seconds <= allowed:
            return
        missed = max(self._in_a_row, int(seconds / self._interval))
        raise SafetyStop(
            f"{missed} deadlines in a row were missed: {_told(seconds)} passed without a command; {said} allows "
            f"{1e3 * allowed:.0f} ms. {_WHY_LATE}{self._acted(seconds)}",
            Cause.LATE,
        )

    def met(self) -> None:
        """Record a sample taken on time. A single stall is tolerated; missing too many deadlines is not."""
        self._in_a_row = 0
        if self._often <= 0.0:
            self.any_missed = False
            self._counted = self._waited = 0
            return
        self._often = max(0.0, self._often - LATE_SHARE)
        if self._often >= self._most_often:
            raise SafetyStop(
                f"More than {100 * LATE_SHARE:.0f} % of the deadlines have been missed{self._why_often()}", Cause.LATE
            )

    def _why_often(self) -> str:
        if 2 * self._waited > self._counted:
            heard = (
                self._heard_instead() or "Check the cables, the supply and whether anything else is sending on the bus."
            )
            return f", most of them while this program waited for replies that were lost or damaged. {heard}"
        return (
            f": the replies arrive too late for {1 / self._interval:g} Hz. `hil check` measures what this bus can do. "
            "Check the adapter's latency timer and the servos' return delay, or lower experiment.rate."
        )

    def check_gap(self, seconds: float) -> None:
        """Check the time between two exchanges: the servos' watchdogs must not have tripped."""
        if seconds >= self._watchdog:
            raise SafetyStop(
                f"This program stalled: {_told(seconds)} passed between two commands. {_WHY_LATE}"
                f"{self._acted(seconds)}",
                Cause.LATE,
            )

    def _acted(self, seconds: float) -> str:
        if seconds < self._watchdog:
            return ""
        # Whether another program had disarmed them is not known afterwards: cutting torque disarms them too.
        return f" Watchdogs that were still armed cut the current after {1e3 * self._watchdog:.0f} ms."


def _told(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 1.0 else f"{1e3 * seconds:.0f} ms"
