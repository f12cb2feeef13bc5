"""One joint's drive while a plant steps: current lag, torque, friction. Plain floats, called every step."""

from math import exp, expm1, sin, tanh

from fakes.arm import Drive

LONGEST_STEP = 0.6e-3  # s: short against the arm's own motion
SHORTEST_STEP = 1e-9  # s: less than this is rounding
STEP_PER_WIDTH = 0.02  # s per rad/s: short against the time the arm takes to cross a smooth friction step


class Motor:
    """The laws of one drive. It holds no state of the arm; its current is the only thing that moves in it."""

    __slots__ = (
        "_coulomb",
        "_lag",
        "_load",
        "_offset",
        "_ripple",
        "_ripple_cycles",
        "_rise",
        "_torque_constant",
        "_velocity_scale",
        "_width",
        "current",
        "longest_step",
        "viscous",
    )

    def __init__(self, drive: Drive) -> None:
        self._lag = drive.current_lag
        self._torque_constant = drive.torque_constant
        self._coulomb = drive.coulomb
        self._width = drive.coulomb_width
        self._rise = drive.coulomb * drive.stribeck_rise
        self._velocity_scale = drive.stribeck_velocity
        self._load = drive.load
        self._offset = drive.offset
        self._ripple = drive.ripple
        self._ripple_cycles = drive.ripple_cycles
        self.viscous = drive.viscous
        self.current = 0.0  # A
        self.longest_step = min(LONGEST_STEP, STEP_PER_WIDTH * self._width) if self._width else LONGEST_STEP

    def push(self, step: float, command: float, angle: float, velocity: float) -> tuple[float, float, float, float]:
        """What the drive does during one step, its angle and velocity given at the step's middle.

        Returns the mean torque without dry friction that sticks [N m], the level of that friction [N m], the
        slope of smooth friction at this velocity [N m s/rad], and the current at the end of the step [A].
        """
        mean = current = command
        if self._lag:
            # A first-order lag under a constant command, exactly: its end and its mean over the step.
            away = self.current - command
            fallen = -expm1(-step / self._lag)
            current += away * (1.0 - fallen)
            mean += away * fallen * self._lag / step
        torque = self._torque_constant * mean
        if self._ripple:
            torque *= 1.0 + self._ripple * sin(self._ripple_cycles * angle)
        level = self._coulomb
        if self._rise:
            ratio = velocity / self._velocity_scale
            level += self._rise * exp(-ratio * ratio)
        if self._load:
            level += self._load * abs(torque)
        torque -= self._offset
        if self._width:
            bend = tanh(velocity / self._width)
            return torque - level * bend, 0.0, level / self._width * (1.0 - bend * bend), current
        return torque, level, 0.0, current
