"""A servo's trajectory: the trapezoidal profile between its previous and present goals."""

from math import copysign, sqrt

VELOCITY_TICKS_PER_MS = 0.229 / 60 * 4096 / 1000
"""Position ticks per millisecond, per unit of Profile Velocity (0.229 rev/min)."""

ACCELERATION_TICKS_PER_MS2 = 214.577 / 3600 * 4096 * 1e-6
"""Position ticks per square millisecond, per unit of Profile Acceleration (214.577 rev/min^2)."""

ACCELERATION_PER_MS = 214.577 / 60_000 / 0.229
"""Units of velocity (0.229 rev/min) per millisecond, per unit of Profile Acceleration."""


class Trajectory:
    """A point that travels to a goal within limits of velocity and acceleration, one millisecond per step.

    Units are position ticks and milliseconds. The goal may change at any time; the point then brakes and, if necessary,
    reverses.
    """

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0

    def start(self, position: float) -> None:
        """Stop at `position`."""
        self.position = position
        self.velocity = self.acceleration = 0.0

    def step(self, goal: float, fastest: float, hardest: float) -> None:
        """Advance by one millisecond towards the goal.

        fastest: velocity limit; with 0, the point jumps to the goal. hardest: acceleration limit; with 0, the velocity
        changes instantly.
        """
        away = goal - self.position
        before = self.velocity
        if not fastest or (not away and not before):
            self.position, self.velocity, self.acceleration = goal, 0.0, 0.0
            return
        wanted = min(fastest, abs(away))
        if hardest:
            # The highest velocity from which it can brake to a stop at the goal.
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
    """Return the velocity limit [ticks/ms] and acceleration limit [ticks/ms^2] for a move of `away` ticks.

    velocity, acceleration: values of the registers Profile Velocity and Profile Acceleration. In a time-based profile
    (Drive Mode bit 2), they are the durations [ms] of the whole move and of its acceleration phase.
    """
    if not time_based:
        return velocity * VELOCITY_TICKS_PER_MS, acceleration * ACCELERATION_TICKS_PER_MS2
    if not velocity:
        return 0.0, 0.0
    accelerating = min(acceleration, velocity // 2)
    fastest = abs(away) / max(velocity - accelerating, 1)
    return fastest, fastest / accelerating if accelerating else 0.0
