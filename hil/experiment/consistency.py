"""Whether a joint's position and velocity tell of the same motion, on every sample.

An encoder whose value freezes still answers, and a velocity that stays at zero is within every limit. But the two are
measured together: what the velocity adds up to must be how far the position went. Evidence is summed one-sidedly (Page
1954), in radians: by how much one of them moved more than three times as far as the other, over short stretches in
which rounding and an encoder's scatter do not count. A real servo filters its velocity, which then lags; so much as
`LAG_S` of the fastest recent motion is therefore forgiven.
"""

from typing import NamedTuple

STRETCH_S = 0.01
"""Least time over which the two are compared."""

TIMES = 3.0
"""How many times as far as the other one of them may seem to have gone."""

LAG_S = 0.02
"""By how much a servo's velocity may lag behind."""

UNMOVED_RAD = 0.015
UNFELT_RAD = 0.03
"""How far a joint may go by its velocity while its position stands still, and the other way round."""

SCATTER_RAD = 3.0e-3
"""Two steps of an encoder with 4,096 to the turn, which a stretch may add to a position that does not move."""

_SPEED_SCATTER = 0.03  # rad/s: about one tick of Present Velocity
_FADES_S = 0.2  # in which the fastest recent motion is forgotten


class Disagreement(NamedTuple):
    """frozen: the position stands still while the velocity goes on; else the reverse. far: by how much [rad]."""

    frozen: bool
    far: float


class Consistency:
    """One joint's position [rad] against its velocity [rad/s]."""

    def __init__(self) -> None:
        self._position: float | None = None
        self._velocity = 0.0
        self._begun = 0.0
        self._seconds = 0.0
        self._by_velocity = 0.0
        self._unmoved = 0.0
        self._unfelt = 0.0
        self._fastest = 0.0

    def look(self, position: float, velocity: float, seconds: float) -> Disagreement | None:
        """The latest sample, `seconds` after the one before it."""
        if self._position is None:
            self._restart(position, velocity)
            return None
        self._by_velocity += 0.5 * (self._velocity + velocity) * seconds
        self._position, self._velocity = position, velocity
        self._seconds += seconds
        if self._seconds < STRETCH_S:
            return None
        seconds = self._seconds
        gone, felt = abs(position - self._begun), abs(self._by_velocity)
        self._begun, self._by_velocity, self._seconds = position, 0.0, 0.0
        faded = self._fastest * (1.0 - seconds / _FADES_S if seconds < _FADES_S else 0.0)
        self._fastest = max(faded, gone / seconds, felt / seconds)
        unmoved = self._unmoved + felt - TIMES * gone - _SPEED_SCATTER * seconds
        unfelt = self._unfelt + gone - TIMES * felt - SCATTER_RAD
        self._unmoved = unmoved if unmoved > 0.0 else 0.0
        self._unfelt = unfelt if unfelt > 0.0 else 0.0
        forgiven = LAG_S * self._fastest
        if unmoved > UNMOVED_RAD + forgiven:
            return Disagreement(True, self._unmoved)
        if unfelt > UNFELT_RAD + forgiven:
            return Disagreement(False, self._unfelt)
        return None

    def lost(self) -> None:
        """A reply is missing: begin anew with the next one."""
        self._position = None

    def _restart(self, position: float, velocity: float) -> None:
        self._position = self._begun = position
        self._velocity = velocity
        self._seconds = self._by_velocity = 0.0
