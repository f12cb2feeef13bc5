"""Check on every sample that a joint's position and velocity agree.

A frozen encoder still answers, and a velocity that stays at zero is within every limit. But the integral of the
velocity must equal the change in position. The difference,

    apart = position - integral of velocity,

is tracked with exponential memories: a short one, which reveals a sudden fault at once, and a long one, which reveals a
creeping one. Rounding and encoder noise do not accumulate in it. What ordinary servos contribute is known:

- a velocity that lags by tau, because the servo filters it: tau times the velocity, less its mean over the memory. Any
  lag up to `LAG_S` is accepted;
- a velocity with a scale error: that fraction of the distance covered within the memory, at most `SCALE`;
- the motion between two samples: the trapezoidal rule's errors cancel over a smooth motion, except at its ends, where
  a fraction `CURVED` of the change of velocity times the interval remains.

A reading that jumps back and forth, as with a stuck bit, cancels in those memories. Therefore each single interval is
also compared with the encoder's noise so far: `STEPS` jumps within `STEPS_S` count as a fault.

Lag and scale error belong to a servo and do not change. Once the joint has moved fast for `LEARNT_S`, twice those
observed by then (by least squares) are accepted, plus `MORE_LAG_S` and `MORE_SCALE`.
"""

SHORT_S, LONG_S = 0.3, 1.2
"""Time constants of the memories [s]."""

LONG_EVERY_S = 0.0099
"""Shortest interval added to the long memory [s]: that of 100 Hz, whatever its rounding."""

UNSURE_RAD, LONG_UNSURE_RAD = 0.02, 0.045
"""Tolerances [rad] for rounding, encoder noise, and a velocity that is rounded towards zero during each memory."""

LAG_S = 0.03
LEARNT_S = 1.5
MORE_LAG_S = 0.008
_FAST_RAD_S = 2.0
"""Smallest range of velocities within the memory from which the lag can be estimated [rad/s]."""

_SEPARATE = 0.05
"""Determinant, relative to uncorrelated signals, below which lag and scale error cannot be told apart."""

_LAG_SHARE = 0.25
"""Allowance for a lag that is not a pure delay, as a fraction of the lag times the range of velocities."""

STEP_RAD, STEP_TIMES = 0.0077, 7.0
"""Smallest jump of a position [rad], five ticks, and its smallest ratio to the RMS of the usual differences."""

STEPS, STEPS_S = 4, 0.5
"""Number of jumps that are too many, and the time within which they must follow each other [s]."""

SCALE, MORE_SCALE = 0.06, 0.02
CURVED = 0.35
"""Allowance for the velocity between samples, as a fraction of its change times the interval. A wave with only four
samples per period, the fastest that is played, needs 0.27.
"""


class Consistency:
    """Compares one joint's position [rad] with its velocity [rad/s].

    It runs for each joint in each exchange, so it is written for speed: comparisons instead of abs and max.
    """

    def __init__(self) -> None:
        self._position: float | None = None
        self._velocity = 0.0
        self._short = _Memory(SHORT_S, UNSURE_RAD)
        self._long = _Memory(LONG_S, LONG_UNSURE_RAD)
        self._sum_seconds = self._sum_moved = self._sum_difference = self._sum_unknown = self._most_curved = 0.0
        self._learnt_for = 0.0
        # Sums of squares and products of the signals per lag and per scale error, and of them with `apart`.
        self._lag_squared = self._scale_squared = self._crossed = 0.0
        self._lag_product = self._scale_product = 0.0
        self._lag, self._scale = LAG_S, SCALE
        self._steps = _Steps()

    def look(self, position: float, velocity: float, seconds: float, unsure: float = 0.0) -> bool:
        """Process the latest sample, `seconds` after the previous one. Returns whether it is inconsistent.

        unsure: excess duration of its exchange [s], by which the time of the measurement is uncertain.
        """
        former, before = self._position, self._velocity
        self._position, self._velocity = position, velocity
        if former is None:
            self._short.restart(velocity)
            self._long.restart(velocity)
            self._forget_sums()
            return False
        moved = position - former
        turned = velocity - before if velocity > before else before - velocity
        difference = moved - 0.5 * (before + velocity) * seconds
        curved = CURVED * seconds * turned
        unknown = unsure * velocity if velocity > 0.0 else -unsure * velocity
        known = LAG_S * turned + SCALE * (moved if moved > 0.0 else -moved) + curved + unknown
        if self._steps.look((difference if difference > 0.0 else -difference) - known, seconds):
            return True
        short = self._short
        short.add(moved, difference, velocity, seconds, curved, unknown)
        if short.is_wrong(velocity, self._lag, self._scale):
            return True
        # The long memory processes several intervals at once: it is slow anyway, and time is scarce.
        self._sum_moved += moved
        self._sum_difference += difference
        self._sum_unknown += unknown
        if curved > self._most_curved:
            self._most_curved = curved
        self._sum_seconds += seconds
        if self._sum_seconds >= LONG_EVERY_S and self._looks_long(velocity):
            return True
        if self._learnt_for < LEARNT_S and short.span > _FAST_RAD_S and not unsure > seconds:
            self._learn(velocity, seconds)
        return False

    def _looks_long(self, velocity: float) -> bool:
        """Add the intervals since the last time to the long memory; return whether it shows a disagreement."""
        long = self._long
        long.add(
            self._sum_moved, self._sum_difference, velocity, self._sum_seconds, self._most_curved, self._sum_unknown
        )
        self._forget_sums()
        return long.is_wrong(velocity, self._lag, self._scale)

    def _forget_sums(self) -> None:
        self._sum_seconds = self._sum_moved = self._sum_difference = self._sum_unknown = self._most_curved = 0.0

    def _learn(self, velocity: float, seconds: float) -> None:
        apart, per_scale = self._short.apart, self._short.far
        per_lag = velocity - self._short.mean
        self._lag_squared += per_lag * per_lag
        self._scale_squared += per_scale * per_scale
        self._crossed += per_lag * per_scale
        self._lag_product += per_lag * apart
        self._scale_product += per_scale * apart
        self._learnt_for += seconds
        if self._learnt_for < LEARNT_S:
            return
        determinant = self._lag_squared * self._scale_squared - self._crossed * self._crossed
        if determinant <= _SEPARATE * self._lag_squared * self._scale_squared:
            return
        lag = (self._lag_product * self._scale_squared - self._scale_product * self._crossed) / determinant
        scale = (self._scale_product * self._lag_squared - self._lag_product * self._crossed) / determinant
        self._lag = min(LAG_S, 2.0 * max(lag, 0.0) + MORE_LAG_S)
        self._scale = min(SCALE, 2.0 * abs(scale) + MORE_SCALE)

    def lost(self) -> None:
        """Restart with the next reply: too many are missing."""
        self._position = None


class _Steps:
    """Counts jumps of a position, which are differences far larger than the usual ones."""

    def __init__(self) -> None:
        self._square = self._age = self._since = 0.0
        self._count = 0

    def look(self, step: float, seconds: float) -> bool:
        """Process the difference over one interval, beyond what its motion explains [rad]; return if it is wrong."""
        if seconds <= 0.0:
            return False
        self._since += seconds
        self._age += seconds
        if step <= 0.0:  # nearly always
            self._square -= seconds / (self._age if self._age < LONG_S else LONG_S) * self._square
            return self._count >= STEPS
        square = step * step
        most = max(STEP_RAD * STEP_RAD, STEP_TIMES * STEP_TIMES * self._square)
        if square > most and self._age > SHORT_S:  # before that, the usual differences are being learnt
            self._count = self._count + 1 if self._since < STEPS_S else 1
            self._since = 0.0
            square = most
        self._square += seconds / min(self._age, LONG_S) * (square - self._square)
        return self._count >= STEPS


class _Memory:
    """Exponential memory with a time constant of `seconds`. unsure: its tolerance [rad].

    apart: position less integral of velocity [rad]. far: distance covered [rad]. mean, span: mean and range of the
    velocity [rad/s].
    """

    __slots__ = ("_curved", "_highest", "_lowest", "_seconds", "_unknown", "_unsure", "apart", "far", "mean", "span")

    def __init__(self, seconds: float, unsure: float) -> None:
        self._seconds, self._unsure = seconds, unsure
        self.restart(0.0)

    def restart(self, velocity: float) -> None:
        self.apart = self.far = self.span = self._curved = self._unknown = 0.0
        self.mean = self._highest = self._lowest = velocity

    def add(
        self, moved: float, difference: float, velocity: float, seconds: float, curved: float, unknown: float
    ) -> None:
        """Add one interval of `seconds`, at the end of which the joint has `velocity`.

        moved, difference: change of position, and the same less the integral of velocity [rad]. curved, unknown: their
        uncertainty [rad], the second of which accumulates.
        """
        kept = 1.0 - seconds / self._seconds if seconds < self._seconds else 0.0
        new = 1.0 - kept
        self.apart = kept * self.apart + difference
        self.far = kept * self.far + moved
        self._unknown = kept * self._unknown + unknown
        faded = kept * self._curved
        self._curved = curved if curved > faded else faded
        self.mean += new * (velocity - self.mean)
        highest, lowest = kept * self._highest + new * velocity, kept * self._lowest + new * velocity
        self._highest = highest = velocity if velocity > highest else highest
        self._lowest = lowest = velocity if velocity < lowest else lowest
        self.span = highest - lowest

    def is_wrong(self, velocity: float, lag: float, scale: float) -> bool:
        """Whether position and velocity disagree, given the largest accepted lag [s] and scale error."""
        of_lag = lag * (velocity - self.mean)
        allowed = self._unsure + scale * abs(self.far) + self._curved + self._unknown + _LAG_SHARE * lag * self.span
        apart = self.apart
        if of_lag > 0.0:
            return apart > allowed + of_lag or apart < -allowed
        return apart > allowed or apart < of_lag - allowed
