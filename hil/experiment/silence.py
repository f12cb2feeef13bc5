"""How long servos have been silent.

Only the time during which this program waited for a reply that did not come counts as silence; for a stalled computer,
the limits on missed deadlines (`hil.experiment.deadlines`) apply.

A busy computer also delays received bytes: the kernel passes on the bytes of a serial port in a separate thread, which,
like any other program, waits for a core for 4 to 10 ms at a time. So while this program itself wakes up late, silence
of all servos may be due to the computer, and the same limits apply.
"""

from math import inf

from hil.config.schema import Config
from hil.plan.silence import (
    Limit,
    bridged_alone_limit,
    bridged_limit,
    is_missing_too_long,
    late_limit,
    missing_limit,
)

LATE_WAKE_UP_S = 1e-3
"""Lateness of this program that indicates a busy computer [s]; on an idle one, it is less than a third of this."""

BUSY_S = 2.0
"""How long the computer counts as busy after this program has woken up late [s]."""


class Silence:
    """Counts the missing replies of each joint.

    interval: time between two exchanges [s]. patience: how long an exchange waits for replies [s].
    heard_at: for an arm that is being lowered, the time at which all servos were last heard before lowering began [s].
    """

    def __init__(self, config: Config, interval: float, patience: float = 0.0, heard_at: float | None = None) -> None:
        count = len(config.joints)
        self._interval = interval
        self._longest_turn = max(interval, patience)
        self._limit = missing_limit(config) if heard_at is None else bridged_limit(config)
        late = late_limit(config)
        self._blind: Limit = max(late, self._limit, key=lambda limit: limit.seconds)
        self._alone = self._limit if heard_at is None else bridged_alone_limit(config)
        self._already = heard_at is not None
        self._asked_at = heard_at
        self._turn: float
        self._last_heard = [-inf if heard_at is None else heard_at] * count
        self._all_heard_at = -inf
        self._listened = [0.0] * count
        self._busy_until = -inf
        self.counts = [0] * count
        """Replies missed in a row, by joint."""
        self.any_missed = False
        """Whether any joint has missed the latest reply."""
        self.others_answer = False
        """Whether some servos are known to seem silent only because a silent servo hides their replies."""

    @property
    def is_busy(self) -> bool:
        """Whether this computer counts as busy because this program recently woke up late."""
        return self._asked_at is not None and self._asked_at < self._busy_until

    def woke_up(self, now: float, late: float) -> None:
        """Record that this program woke up at `now` [s], `late` [s] after the intended time."""
        if late >= LATE_WAKE_UP_S:
            self._busy_until = now + BUSY_S

    def ask(self, now: float) -> None:
        """Record an exchange that began at `now` [s]; not called if all joints replied to it (see `all_heard`)."""
        since = 0.0 if self._asked_at is None else now - self._asked_at
        self._turn = since if since < self._longest_turn else self._longest_turn
        self._asked_at = now

    def heard(self, joint: int, now: float) -> None:
        """Record a reply to the exchange that began at `now` [s]."""
        self.counts[joint] = 0
        self._listened[joint] = 0.0
        self._last_heard[joint] = now
        self.others_answer = False
        self.any_missed = any(self.counts)

    def all_heard(self, now: float) -> None:
        """Record an exchange begun at `now` [s]; all joints replied to it and to the previous one."""
        self._asked_at = self._all_heard_at = now

    def missed(self, joint: int, now: float, *, answered: bool, refused: bool, alone: bool) -> str | None:
        """Record a missing reply to an exchange; return a description of a silence that is too long, or None.

        now: when that exchange began, or when waiting for its replies ended [s].

        answered: whether the servo answered with an error instead of its state. refused: whether that error shows that
        it received the request undamaged; such an answer counts as two missing replies. alone: whether at least one
        other servo was heard.
        """
        last = max(self._last_heard[joint], self._all_heard_at)
        if last == -inf:
            last = self._last_heard[joint] = now
        self.any_missed = True
        self.counts[joint] += 1
        self._listened[joint] += self._turn
        waited = 0.0 if self._asked_at is None else now - self._asked_at
        listened = max(self._listened[joint] + waited, self.counts[joint] * self._interval)
        elapsed = max(now - last, listened)
        count = self.counts[joint] + refused
        count += self._already  # replies may have been missing before the arm was lowered
        # If the servo answered at all, even with an error, a busy computer did not hide its reply.
        together = self._blind if self.is_busy and not answered else self._limit
        allowed = self._alone if alone or self.others_answer else together
        for seconds, limit in ((listened, allowed), (elapsed, self._blind)):
            if is_missing_too_long(count, seconds, limit):
                delayed = self._delayed(elapsed - listened)
                return f"{_ms(elapsed)} ago{delayed}; {limit.said} allows {_ms(limit.seconds)}"
        return None

    def _delayed(self, seconds: float) -> str:
        """Return a phrase that attributes `seconds` [s] of a silence to this computer. Returns "" if that time is short
        or, while the arm is being lowered, if the computer is not known to be busy.
        """
        is_told = seconds >= LATE_WAKE_UP_S and (self.is_busy or not self._already)
        return f", {_ms(seconds)} of it because this computer was busy" if is_told else ""


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms"
