"""How long servos have not replied, by the time for which this program listened to them.

While a computer stalls it hears nothing and sends nothing, which says nothing about the servos. That time is limited as
missed deadlines are (`hil.experiment.deadlines`); silence proper is time in which a reply was awaited in vain.
"""

from hil.config.schema import Config
from hil.plan.silence import is_missing_too_long, late_limit, missing_limit

_DELAYED_S = 1e-3
"""Delay of this program that is worth mentioning [s]."""


class Silence:
    """Counts the missing replies of each joint.

    interval: time between two exchanges [s]. patience: how long an exchange waits for replies [s].
    """

    def __init__(self, config: Config, interval: float, patience: float = 0.0) -> None:
        self._interval = interval
        self._longest_turn = max(interval, patience)
        self._limit = missing_limit(config)
        self._longest_s = max(late_limit(config).seconds, self._limit.seconds)
        self._asked_at: float | None = None
        self._turn = 0.0
        self._last_heard: list[float | None] = [None] * len(config.joints)
        self._listened = [0.0] * len(config.joints)
        self.counts = [0] * len(config.joints)
        """Replies missed in a row, by joint."""

    def ask(self, now: float) -> None:
        """Begin an exchange at `now` [s]."""
        since = 0.0 if self._asked_at is None else now - self._asked_at
        self._turn = min(since, self._longest_turn)
        self._asked_at = now

    def heard(self, joint: int, now: float) -> None:
        """Record a reply to the exchange that began at `now` [s]."""
        self.counts[joint] = 0
        self._listened[joint] = 0.0
        self._last_heard[joint] = now

    def missed(self, joint: int, now: float, *, refused: bool) -> str | None:
        """Record a missing reply to the exchange that began at `now` [s]; return what was too long, or None.

        refused: the servo answered, with an error instead of its state; one such answer is enough.
        """
        last = self._last_heard[joint]
        if last is None:
            last = self._last_heard[joint] = now
        self.counts[joint] += 1
        self._listened[joint] += self._turn
        listened = max(self._listened[joint], self.counts[joint] * self._interval)
        elapsed = max(now - last, listened)
        count = self.counts[joint] + refused
        if not is_missing_too_long(count, listened, self._limit) and (count < 2 or elapsed < self._longest_s):
            return None
        delay = elapsed - listened
        delayed = f", {_ms(delay)} of it because this computer was busy" if delay >= _DELAYED_S else ""
        return f"{_ms(elapsed)} ago{delayed}; {self._limit.said} allows {_ms(self._limit.seconds)}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms"
