"""One joint's drive while a plant steps: current lag, torque, friction, stops. Plain floats, called every step."""

from math import exp, expm1, sin, tanh

from fakes.arm import Drive

LONGEST_STEP = 0.6e-3  # s: short against the arm's own motion
SHORTEST_STEP = 1e-9  # s: less than this is rounding
STEP_PER_WIDTH = 0.02  # s per rad/s: short against the time the arm takes to cross a smooth friction step
JAM = 1e6  # N m of dry friction: more than anything here can push


class Motor:
    """The laws of one drive. It holds no state of the arm; its current is the only thing that moves in it."""

    __slots__ = (
        "_drive",
        "_lag",
        "_left",
        "_mean_left",
        "_shaped",
        "_step",
        "_width",
        "constants",
        "current",
        "jammed",
        "longest_step",
        "viscous",
    )

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._lag = drive.current_lag
        self._width = drive.coulomb_width
        self._shaped = bool(drive.ripple or drive.cogging or drive.load or drive.stops)
        self._step = self._left = self._mean_left = 0.0
        self.constants = (
            drive.torque_constant,
            drive.offset,
            drive.coulomb,
            drive.coulomb * drive.stribeck_rise,
            1.0 / drive.stribeck_velocity,
        )
        """Torque constant, offset, Coulomb level, Stribeck rise, 1 / Stribeck velocity."""
        self.viscous = drive.viscous
        self.jammed = False
        """True: something holds the joint fast."""
        self.current = 0.0  # A
        self.longest_step = min(LONGEST_STEP, STEP_PER_WIDTH * self._width) if self._width else LONGEST_STEP

    @property
    def is_plain(self) -> bool:
        """Whether lag, torque, offset and sticking Stribeck friction are all there is to it."""
        return not (self._shaped or self._width or self.jammed)

    def push(self, step: float, command: float, angle: float, velocity: float) -> tuple[float, float, float, float]:
        """What the drive does during one step, its angle and velocity given at the step's middle.

        Returns the mean torque without dry friction that sticks [N m], the level of that friction [N m], the
        slope of smooth friction at this velocity [N m s/rad], and the current at the end of the step [A].
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
        if self.jammed:
            level += JAM
        return torque, level, slope, command + away * left

    def lag(self, step: float) -> tuple[float, float]:
        """How much of a current's distance from its command is left at the end of a step, and on its average."""
        if self._lag and step != self._step:
            # A first-order lag under a constant command, exactly.
            self._step = step
            fallen = -expm1(-step / self._lag)
            self._left = 1.0 - fallen
            self._mean_left = fallen * self._lag / step
        return self._left, self._mean_left

    def _shape(
        self, step: float, torque: float, level: float, angle: float, velocity: float
    ) -> tuple[float, float, float]:
        """Ripple, cogging, friction from load and stops, which only some drives have."""
        drive = self._drive
        slope = 0.0
        if drive.ripple:
            torque *= 1.0 + drive.ripple * sin(drive.ripple_cycles * angle)
        if drive.load:
            level += drive.load * abs(torque)
        if drive.cogging:
            # Its mean over the step: a joint that turns through whole cycles in a step feels nothing of them.
            half = 0.5 * step * drive.cogging_cycles * velocity
            torque += drive.cogging * sin(drive.cogging_cycles * angle) * (sin(half) / half if half else 1.0)
        if drive.stops is not None:
            low, high = drive.stops
            if angle > high or angle < low:
                beyond = angle - high if angle > high else angle - low
                torque -= drive.stop_stiffness * beyond + drive.stop_damping * velocity
                slope = drive.stop_damping
        return torque, level, slope
