"""Check on every sample that a joint's position and velocity agree.

A frozen encoder still answers, and a velocity that stays at zero is within every limit. But the integral of the
velocity must equal the change in position. The difference,

    position - integral of velocity,

is tracked with an exponential memory of `MEMORY_S`. Rounding and encoder noise do not accumulate in it, and a velocity
that lags by tau, because the servo filters it, contributes at most tau times the change of velocity. The tolerance
allows for a lag of `LAG_S`, a scale error of `SCALE` and the interval between samples. Once the joint has moved fast
for `LEARNT_S`, it allows for only twice the largest lag observed so far plus `MORE_LAG_S`: a lag does not grow.
"""

MEMORY_S = 0.3
LAG_S = 0.03
LEARNT_S = 1.5
MORE_LAG_S = 0.008
_FAST_RAD_S = 2.0
"""Smallest range of velocities within the memory from which the lag can be estimated [rad/s]."""

SCALE = 0.06
UNSURE_RAD = 0.02
"""Allowance [rad] for rounding, encoder noise, and a velocity bias of half a tick over MEMORY_S."""

CURVED = 0.25
"""Allowance for the velocity between samples, as a fraction of its change times the interval.

A wave with four samples per period, the fastest that is played, deviates by 21 %.
"""


class Consistency:
    """Compares one joint's position [rad] with its velocity [rad/s]."""

    def __init__(self) -> None:
        self._position: float | None = None
        self._velocity = 0.0
        self._apart = 0.0
        self._open = 0.0
        self._highest = self._lowest = 0.0
        self._lag_seen = 0.0
        self._learnt_for = 0.0
        self._lag = LAG_S

    def look(self, position: float, velocity: float, seconds: float, unsure: float = 0.0) -> bool:
        """Process the latest sample, `seconds` after the previous one. Returns whether it is inconsistent.

        unsure: excess duration of its exchange [s], in which the time of the measurement is not known.
        """
        former, self._position = self._position, position
        before, self._velocity = self._velocity, velocity
        if former is None:
            self._apart = self._open = 0.0
            self._highest = self._lowest = velocity
            return False
        kept = 1.0 - seconds / MEMORY_S if seconds < MEMORY_S else 0.0
        moved, felt = position - former, 0.5 * (before + velocity) * seconds
        change = velocity - before
        self._apart = kept * self._apart + moved - felt
        self._open = kept * self._open + SCALE * abs(moved)
        self._open += CURVED * seconds * abs(change) + unsure * abs(velocity)
        highest, lowest = kept * self._highest + (1 - kept) * velocity, kept * self._lowest + (1 - kept) * velocity
        self._highest = highest = velocity if velocity > highest else highest
        self._lowest = lowest = velocity if velocity < lowest else lowest
        span = highest - lowest
        allowed = UNSURE_RAD + self._lag * span + self._open
        if not -allowed <= self._apart <= allowed:
            return True
        if span > _FAST_RAD_S and not unsure > seconds:
            self._learn_lag(abs(self._apart) / span, seconds)
        return False

    def _learn_lag(self, lag: float, seconds: float) -> None:
        self._lag_seen = max(self._lag_seen, lag)
        self._learnt_for += seconds
        if self._learnt_for >= LEARNT_S:
            self._lag = min(LAG_S, 2.0 * self._lag_seen + MORE_LAG_S)

    def lost(self) -> None:
        """Restart with the next reply, because one is missing."""
        self._position = None
