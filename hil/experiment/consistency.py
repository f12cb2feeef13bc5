"""Whether a joint's position and velocity agree, on every sample.

An encoder whose value freezes still answers, and a velocity that stays at zero is within every limit. But the two are
measured together: what the velocity adds up to must be how far the position went. The difference of the two,

    position - integral of velocity,

is kept with the last `MEMORY_S` weighing most. Rounding and an encoder's scatter do not add up in it, and a velocity
that lags by tau, since a real servo filters it, makes it tau times the change of velocity and no more. What a lag of
`LAG_S`, a scale that is `SCALE` off and the samples' distance leave open is forgiven.
"""

MEMORY_S = 0.3
LAG_S = 0.03
SCALE = 0.06
UNSURE_RAD = 0.02
"""Rounding of both, an encoder's scatter, and the velocity's bias of half a tick over MEMORY_S."""

CURVED = 0.25
"""Of the change of velocity, times its time: what a velocity known at the samples alone leaves open in between. A wave
of four samples a period, the fastest that is played, is 21 % off.
"""


class Consistency:
    """One joint's position [rad] against its velocity [rad/s]."""

    def __init__(self) -> None:
        self._position: float | None = None
        self._velocity = 0.0
        self._apart = 0.0
        self._open = 0.0
        self._highest = self._lowest = 0.0

    def look(self, position: float, velocity: float, seconds: float, unsure: float = 0.0) -> bool:
        """Process the latest sample, `seconds` after the previous one. Returns whether it is inconsistent.

        unsure: by how much longer than usual its exchange took [s]: when in it the servo measured is not known.
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
        allowed = UNSURE_RAD + LAG_S * (highest - lowest) + self._open
        return not -allowed <= self._apart <= allowed

    def lost(self) -> None:
        """A reply is missing: restart with the next one."""
        self._position = None
