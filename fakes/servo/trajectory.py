"""A servo's trajectory: the trapezoidal profile between its last and its present goal."""

from math import copysign, sqrt

VELOCITY_TICKS_PER_MS = 0.229 / 60 * 4096 / 1000
"""Position ticks per millisecond, per unit of Profile Velocity (0.229 rev/min)."""

ACCELERATION_TICKS_PER_MS2 = 214.577 / 3600 * 4096 * 1e-6
"""Position ticks per square millisecond, per unit of Profile Acceleration (214.577 rev/min^2)."""

ACCELERATION_PER_MS = 214.577 / 60_000 / 0.229
"""Units of velocity (0.229 rev/min) per millisecond, per unit of Profile Acceleration."""


class Trajectory:
    """A point that travels to a goal within a velocity and an acceleration, one millisecond a step.

    Units are position ticks and milliseconds. It may be given a new goal at any time: it brakes and turns.
    """

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0

    def start(self, position: float) -> None:
        """Stand still at `position`."""
        self.position = position
        self.velocity = self.acceleration = 0.0

    def step(self, goal: float, fastest: float, hardest: float) -> None:
        """One millisecond towards the goal. fastest 0: at once; hardest 0: at the fastest velocity at once."""
        away = goal - self.position
        before = self.velocity
        if not fastest or (not away and not before):
            self.position, self.velocity, self.acceleration = goal, 0.0, 0.0
            return
        wanted = min(fastest, abs(away))
        if hardest:
            # Of the velocities from which it can brake to a stand at the goal, the highest.
            wanted = min(wanted, sqrt(2.0 * hardest * abs(away) + 0.25 * hardest**2) - 0.5 * hardest)
        self.velocity = copysign(wanted, away)
        if hardest:
            change = self.velocity - before
            self.velocity = before + max(-hardest, min(hardest, change))
        self.acceleration = self.velocity - before
        self.position += self.velocity
        if abs(goal - self.position) < 1e-3 and (not hardest or abs(before) <= hardest):
            self.position, self.velocity, self.acceleration = goal, 0.0, 0.0


def profile(away: float, velocity: int, acceleration: int, time_based: bool) -> tuple[float, float]:
    """Fastest velocity [ticks/ms] and hardest acceleration [ticks/ms^2] for a move of `away` ticks.

    velocity, acceleration: the registers Profile Velocity and Profile Acceleration, which on a time-based profile
    (Drive Mode bit 2) are the durations of the whole move and of its acceleration [ms].
    """
    if not time_based:
        return velocity * VELOCITY_TICKS_PER_MS, acceleration * ACCELERATION_TICKS_PER_MS2
    if not velocity:
        return 0.0, 0.0
    accelerating = min(acceleration, velocity // 2)
    fastest = abs(away) / max(velocity - accelerating, 1)
    return fastest, fastest / accelerating if accelerating else 0.0
