"""The drive of one joint during a time step: current lag, torque, friction, hard stops. This code runs in every step,
so it uses plain floats.

Presliding friction follows Canudas de Wit, Olsson, Astrom and Lischinsky (IEEE Transactions on Automatic Control 40
(1995) 419): bristles deflect with the joint and slip,

    friction = stiffness deflection + damping deflection'
    deflection' = velocity (1 - stiffness deflection / +-level)
"""

from math import copysign, exp, expm1, sin, sqrt, tanh

from hil.fakes.plants.arm import Drive, armature

LONGEST_STEP = 0.6e-3  # s: short compared with the time scale of the arm's motion
SHORTEST_STEP = 1e-9  # s: anything shorter is rounding error
STEP_PER_WIDTH = 0.02  # s per rad/s: short compared with the time in which the arm crosses a smooth friction step
STEP_PER_SWING = 0.2  # fraction of the time in which a rotor on its bristles oscillates through one radian
LEAST_GRIP = 5.0  # N m s/rad between a hand and the joint that it moves
JAM = 1e6  # N m of dry friction: more than any drive here can overcome


class Motor:
    """The physics of one drive. Its state consists of its current and the deflection of its friction bristles."""

    __slots__ = (
        "_bent",
        "_bristle_damping",
        "_drive",
        "_lag",
        "_left",
        "_level",
        "_mean_left",
        "_shaped",
        "_step",
        "_warms_up",
        "_width",
        "bristle_stiffness",
        "bristle_torque",
        "constants",
        "current",
        "held_at",
        "jammed",
        "longest_step",
        "plain",
        "viscous",
    )

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._lag = drive.current_lag
        self._width = drive.coulomb_width
        self._shaped = bool(
            drive.ripple or drive.cogging or drive.load or drive.stops or drive.saturation or drive.cable_stiffness
        )
        # The torque is the linear one times 1 / sqrt(1 + x^2), scaled to lose `saturation` at `saturation_current`.
        self._bent = (1.0 / (1.0 - drive.saturation) ** 2 - 1.0) / (
            drive.torque_constant * drive.saturation_current
        ) ** 2
        self._warms_up = drive.warms_up
        self._step = self._left = self._mean_left = self._level = 0.0
        self._bristle_damping = drive.presliding_damping
        self.bristle_stiffness = drive.presliding_stiffness
        """Stiffness of presliding friction [N m/rad]; 0 for rigid stiction."""
        self.bristle_torque = 0.0  # N m
        self._set_friction(0.0)
        self.jammed = False
        """Whether the joint is blocked."""
        self.held_at: float | None = None
        """Velocity at which a hand moves the joint [rad/s]; None if no hand holds it."""
        self.current = 0.0  # A
        self.longest_step = min(LONGEST_STEP, STEP_PER_WIDTH * self._width) if self._width else LONGEST_STEP
        if self.bristle_stiffness and drive.rotor_inertia:
            swing = sqrt(armature(drive) / self.bristle_stiffness)
            self.longest_step = min(LONGEST_STEP, STEP_PER_SWING * swing)

    def warm_up(self, time: float) -> None:
        """Set friction to its value at `time` [s] since power-up."""
        if self._warms_up:
            self._set_friction(time)

    def _set_friction(self, time: float) -> None:
        drive = self._drive
        viscous, dry = drive.coldness(time)
        self.constants = (
            drive.torque_constant,
            drive.offset,
            drive.coulomb * dry,
            drive.coulomb * dry * drive.stribeck_rise,
            1.0 / drive.stribeck_velocity,
        )
        """Torque constant [N m/A], offset and Coulomb level [N m], Stribeck rise [1], 1 / Stribeck velocity [s/rad]."""
        self.viscous = drive.viscous * viscous
        self.plain = (*self.constants, self.viscous, self._lag, self._width)
        """All parameters of a plain drive: `constants`, viscous friction [N m s/rad], current lag [s], and width of
        smooth friction [rad/s].
        """

    @property
    def is_plain(self) -> bool:
        """Whether the drive has only effects that `plain` describes: lag, offset, viscous and Stribeck friction."""
        return not (self._shaped or self.bristle_stiffness or self.jammed or self.held_at is not None)

    def push(self, step: float, command: float, angle: float, velocity: float) -> tuple[float, float, float, float]:
        """Return the effect of the drive over a step of `step` [s], given angle and velocity at the middle of the step.

        command: commanded current [A]. Returns the mean torque without stiction [N m], the level of the dry friction
        that can hold the joint [N m], the slope of the smooth friction at this velocity [N m s/rad], and the current at
        the end of the step [A].
        """
        torque_constant, offset, level, rise, per_velocity = self.constants
        left, mean_left = self.lag(step)
        away = self.current - command
        torque = torque_constant * (command + away * mean_left)
        slope = 0.0
        if rise:
            ratio = velocity * per_velocity
            level += rise * exp(-ratio * ratio)
        if self._shaped:
            torque, level, slope = self._shape(step, torque, level, angle, velocity)
        torque -= offset
        if self._width:
            bend = tanh(velocity / self._width)
            torque -= level * bend
            slope += level / self._width * (1.0 - bend * bend)
            level = 0.0
        elif self.bristle_stiffness:
            self._level = level
            end = copysign(level, velocity)
            turns = self.bristle_stiffness * abs(velocity) * step / level
            # Exact mean over a step at constant velocity.
            bent = end + (self.bristle_torque - end) * (-expm1(-turns) / turns if turns else 1.0)
            give = 1.0 - copysign(bent, bent * velocity) / level
            stiff = (0.5 * step * self.bristle_stiffness + self._bristle_damping) * give
            torque -= bent + self._bristle_damping * give * velocity
            slope += stiff
            level = 0.0
        if self.jammed:
            level += JAM
        if self.held_at is not None:
            # The grip is just stiff enough to move a bare rotor within one step.
            grip = max(2.0 * armature(self._drive) / step, LEAST_GRIP)
            torque += grip * (self.held_at - velocity)
            slope += grip
        return torque, level, slope, command + away * left

    def bend(self, step: float, velocity: float) -> None:
        """Advance the bristles through the step last passed to `push`, now that its mean velocity [rad/s] is known."""
        if self.bristle_stiffness:
            self.bristle_torque = self._slipped(step, velocity)

    def _slipped(self, step: float, velocity: float) -> float:
        """Return the exact bristle torque after `step` [s] at a constant velocity [N m]."""
        end = copysign(self._level, velocity)
        return end + (self.bristle_torque - end) * exp(-self.bristle_stiffness * abs(velocity) * step / self._level)

    def lag(self, step: float) -> tuple[float, float]:
        """Return the fraction of a current error that remains after `step` [s], and the mean fraction over the step."""
        if self._lag and step != self._step:
            # Exact solution of a first-order lag under a constant command.
            self._step = step
            fallen = -expm1(-step / self._lag)
            self._left = 1.0 - fallen
            self._mean_left = fallen * self._lag / step
        return self._left, self._mean_left

    def _shape(
        self, step: float, torque: float, level: float, angle: float, velocity: float
    ) -> tuple[float, float, float]:
        """Apply the optional effects: saturation, ripple, cogging, load-dependent friction, cables and hard stops."""
        drive = self._drive
        slope = 0.0
        if self._bent:
            torque /= sqrt(1.0 + self._bent * torque * torque)
        if drive.ripple:
            torque *= 1.0 + drive.ripple * sin(drive.ripple_cycles * angle)
        if drive.load:
            level += drive.load * abs(torque)
        if drive.cogging:
            # Mean over the step: a joint that turns through whole cycles within a step experiences no net cogging.
            half = 0.5 * step * drive.cogging_cycles * velocity
            torque += drive.cogging * sin(drive.cogging_cycles * angle) * (sin(half) / half if half else 1.0)
        if drive.cable_stiffness:
            torque -= drive.cable_stiffness * (angle - drive.cable_angle)
        if drive.stops is not None:
            low, high = drive.stops
            if angle > high or angle < low:
                beyond = angle - high if angle > high else angle - low
                torque -= drive.stop_stiffness * beyond + drive.stop_damping * velocity
                slope = drive.stop_damping
        return torque, level, slope
