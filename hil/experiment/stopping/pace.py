"""Choose how often to command an arm that is being lowered, and how long to wait for replies, which may be late.

Servos hold their latest goal. If replies come too late for one exchange per sample, only every second or third sample
is exchanged from then on, until the end.
"""

from math import ceil, inf

from hil.plan.silence import BRIDGED_ALONE_S

LONGER_S = 0.008
"""Margin of the reply timeout of the last exchange before a silence is too long [s]. It is added to the longest time
that replies have taken since lowering began or, at first, to the timeout used during the experiment.
"""

LONGEST_S = 0.022
"""Reply timeout after some replies have been late [s]: longer than an adapter's latency timer of 16 ms."""

LAST_S = 0.075
"""Waiting always ends this long after the latest reply [s]: torque must be off 25 ms later."""

MARGIN_S = 0.002
"""Time between the end of an exchange and the next goals, and margin of the usual reply timeout [s]."""


class Pace:
    """Adapts the interval between exchanges and the reply timeout to late replies.

    interval: time between two samples [s]. patience: reply timeout during the experiment [s]. quickest: time within
    which replies arrive if this computer is not busy [s].
    """

    def __init__(self, interval: float, patience: float, quickest: float = inf) -> None:
        self._interval = interval
        self._least = patience
        self._quickest = min(patience, quickest)
        self._longest = 0.0
        self._first = self._usual = max(patience, min(patience + LONGER_S, LONGEST_S))
        self._was_late = self._is_longer = False
        self.every = 1
        """Number of samples per exchange."""

    def patience(self, unheard: float, *, are_late: bool, are_damaged: bool = False) -> float:
        """How long the next exchange may wait for replies [s].

        unheard: time since all servos last replied [s]. are_late, are_damaged: whether recent replies were too late, or
        destroyed on the way.
        """
        if not are_late and not self._was_late:
            # Lost replies are asked for again soon; the last exchange before the limit waits for late ones.
            is_last = not are_damaged and unheard + self._quickest > BRIDGED_ALONE_S
            # Whoever destroys replies periodically must not meet every request.
            self._is_longer = are_damaged and not self._is_longer
            shortest = self._least if self._is_longer else self._quickest
            return self._usual if is_last else min(max(shortest, self._longest + MARGIN_S), self._usual)
        return max(min(max(self._least, LONGEST_S), LAST_S - unheard), LONGER_S)

    def took(self, seconds: float, *, missed: bool) -> None:
        """Process an exchange that took `seconds` [s]. missed: whether replies were still missing at the end."""
        if missed:
            return
        usual, self._longest = self._usual, max(self._longest, seconds)
        self._usual = min(self._first, self._longest + LONGER_S)
        if seconds <= min(self.every * self._interval, usual):
            return
        # A single late reply may be due to a busy computer.
        if self._was_late and seconds > self.every * self._interval:
            self.every = ceil((seconds + MARGIN_S) / self._interval)
        self._was_late = True
