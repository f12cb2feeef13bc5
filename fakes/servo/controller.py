"""Motor control in each operating mode: PWM and current from goals, gains and profile.

Source: the block diagrams and gain units of the ROBOTIS e-Manual (pages x/<model>, Velocity PI Gain, Position PID
Gain). The units are 1/128 for P gains, 1/65536 for I gains, 1/16 for the D gain, 1/4 and 1 for the feedforward gains.
The period of the control loop (1 ms here), the signal that the D gain multiplies, and the filters are uncertain.
"""

import math
from dataclasses import dataclass

from hil.fakes.servo.memory import Memory
from hil.fakes.servo.registers import VELOCITY_UNIT_RPM, EmulatedModel
from hil.fakes.servo.trajectory import ACCELERATION_PER_MS, VELOCITY_TICKS_PER_MS, Trajectory, profile

CURRENT_MODE = 0
VELOCITY_MODE = 1
POSITION_MODE = 3
EXTENDED_POSITION_MODE = 4
CURRENT_POSITION_MODE = 5
PWM_MODE = 16
POSITION_MODES = frozenset({POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_POSITION_MODE})
GOAL_OF_MODE = {CURRENT_MODE: "Goal Current", VELOCITY_MODE: "Goal Velocity", PWM_MODE: "Goal PWM"}

FULL_PWM = 885
"""Goal PWM at which the whole supply voltage is applied to the motor."""

IN_POSITION_TICKS = 20
"""Distance from the goal below which Moving Status reports in-position; the value is uncertain."""

_TIME_BASED = 0x04  # bit of Drive Mode

# Bits of Moving Status
_IN_POSITION = 0x01
_PROFILE_ONGOING = 0x02
_FOLLOWING_ERROR = 0x08
_RECTANGLE, _TRIANGLE, _TRAPEZOID = 0x10, 0x20, 0x30
_TICKS_PER_RAD_S = 60 / math.tau / VELOCITY_UNIT_RPM


def obeyed_current(memory: Memory) -> int:
    """Return the Goal Current that is applied [ticks]. Current Limit applies even if it was lowered afterwards."""
    goal, limit = memory.get("Goal Current"), memory.get("Current Limit")
    return max(-limit, min(limit, goal))


@dataclass(frozen=True, slots=True)
class Goals:
    """Values of the registers that the controller uses, in the units of the registers."""

    mode: int
    pwm: int
    pwm_limit: int
    current: int
    velocity: int
    position: int
    profile_velocity: int
    profile_acceleration: int
    time_based: bool
    velocity_i: int
    velocity_p: int
    position_d: int
    position_i: int
    position_p: int
    feedforward_2: int
    feedforward_1: int

    @classmethod
    def read(cls, mode: int, memory: Memory) -> "Goals":
        """Return the goals of a control table; 0 for registers that the model lacks."""
        value = memory.get
        return cls(
            mode=mode,
            pwm=value("Goal PWM"),
            pwm_limit=value("PWM Limit"),
            current=obeyed_current(memory),
            velocity=value("Goal Velocity"),
            position=value("Goal Position"),
            profile_velocity=value("Profile Velocity"),
            profile_acceleration=value("Profile Acceleration"),
            time_based=bool(value("Drive Mode") & _TIME_BASED),
            velocity_i=value("Velocity I Gain"),
            velocity_p=value("Velocity P Gain"),
            position_d=value("Position D Gain"),
            position_i=value("Position I Gain"),
            position_p=value("Position P Gain"),
            feedforward_2=value("Feedforward 2nd Gain"),
            feedforward_1=value("Feedforward 1st Gain"),
        )


class Controller:
    """The control loop of one servo, run once per millisecond while torque is on."""

    def __init__(self) -> None:
        self.goals: Goals | None = None
        self.trajectory = Trajectory()
        self.velocity_trajectory = 0.0
        """Present setpoint of velocity control [0.229 rev/min]."""
        self._integral = 0.0
        self._error_before = 0.0
        self._goal_before: float | None = None
        self._fastest = self._hardest = 0.0
        self._shape = _RECTANGLE

    def start(self, position_ticks: float) -> None:
        """Start from rest at the present position, when torque is switched on or the mode changes."""
        self.trajectory.start(position_ticks)
        self.velocity_trajectory = 0.0
        self._integral = self._error_before = 0.0
        self._goal_before = None

    def shift(self, ticks: int) -> None:
        """Shift the setpoint and goal of position control by the same amount as Present Position."""
        self.trajectory.position += ticks
        if self._goal_before is not None:
            self._goal_before += ticks

    def motor_current(
        self, model: EmulatedModel, supply_v: float, position_ticks: float, velocity: float, rotor_velocity: float
    ) -> float:
        """Run one millisecond of control; return the motor current [A], limited by the supply voltage.

        velocity, rotor_velocity: velocities of the output shaft and of the rotor, referred to the shaft, in the servo's
        sense of rotation [rad/s].
        """
        goals = self.goals
        if goals is None:
            return 0.0
        back = model.back_emf_v_s * rotor_velocity
        limit = min(goals.pwm_limit, abs(goals.pwm))
        if goals.mode == CURRENT_MODE:
            wanted = goals.current * model.current_unit_a
        elif goals.mode == CURRENT_POSITION_MODE:
            wanted = self._position_control(goals, position_ticks, abs(goals.current)) * model.current_unit_a
        else:
            pwm = self._pwm(goals, position_ticks, velocity * _TICKS_PER_RAD_S)
            wanted = (pwm / FULL_PWM * supply_v - back) / model.resistance_ohm
        most = limit / FULL_PWM * supply_v
        return max((-most - back) / model.resistance_ohm, min((most - back) / model.resistance_ohm, wanted))

    def state(self, position_ticks: float) -> tuple[int, float, float]:
        """Return the registers Moving Status, Velocity Trajectory and Position Trajectory, before rounding."""
        velocity = self.trajectory.velocity / VELOCITY_TICKS_PER_MS
        if self.goals is not None and self.goals.mode == VELOCITY_MODE:
            velocity = self.velocity_trajectory
        return self._moving_status(position_ticks), velocity, self.trajectory.position

    def _pwm(self, goals: Goals, position_ticks: float, velocity_ticks: float) -> float:
        if goals.mode == PWM_MODE:
            return float(goals.pwm)
        if goals.mode == VELOCITY_MODE:
            return self._velocity_control(goals, velocity_ticks, abs(goals.pwm))
        return self._position_control(goals, position_ticks, abs(goals.pwm))

    def _moving_status(self, position_ticks: float) -> int:
        """Return the Moving Status register. The firmware's threshold for a following error is uncertain."""
        goals = self.goals
        if goals is None or goals.mode not in POSITION_MODES:
            return 0
        status = _IN_POSITION if abs(goals.position - position_ticks) <= IN_POSITION_TICKS else 0
        if self.trajectory.velocity:
            status |= _PROFILE_ONGOING | self._shape
        if abs(self.trajectory.position - position_ticks) > 4 * IN_POSITION_TICKS:
            status |= _FOLLOWING_ERROR
        return status

    def _velocity_control(self, goals: Goals, velocity_ticks: float, limit: float) -> float:
        change = goals.velocity - self.velocity_trajectory
        if goals.profile_acceleration:
            most = goals.profile_acceleration * ACCELERATION_PER_MS
            change = max(-most, min(most, change))
        self.velocity_trajectory += change
        error = self.velocity_trajectory - velocity_ticks
        return self._limited(goals.velocity_p / 128 * error, goals.velocity_i / 65_536 * error, limit)

    def _position_control(self, goals: Goals, position_ticks: float, limit: float) -> float:
        trajectory = self.trajectory
        if goals.position != self._goal_before:
            self._goal_before = goals.position
            away = goals.position - trajectory.position
            self._fastest, self._hardest = profile(
                away, goals.profile_velocity, goals.profile_acceleration, goals.time_based
            )
            self._shape = _shape(away, trajectory.velocity, self._fastest, self._hardest)
        trajectory.step(goals.position, self._fastest, self._hardest)
        error = trajectory.position - position_ticks
        slope, self._error_before = error - self._error_before, error
        proportional = goals.position_p / 128 * error + goals.position_d / 16 * slope
        proportional += goals.feedforward_1 / 4 * trajectory.velocity + goals.feedforward_2 * trajectory.acceleration
        return self._limited(proportional, goals.position_i / 65_536 * error, limit)

    def _limited(self, proportional: float, integrated: float, limit: float) -> float:
        """Return the sum of proportional term and integral, clamped to +-limit.

        The integral is frozen while the limit is active (anti-windup).
        """
        wanted = proportional + self._integral + integrated
        if abs(wanted) <= limit or wanted * integrated < 0.0:
            self._integral += integrated
        return max(-limit, min(limit, wanted))


def _shape(away: float, velocity: float, fastest: float, hardest: float) -> int:
    """Return the bits of Moving Status that give the shape of the velocity profile for a move of `away` ticks.

    The profile is triangular if it does not reach its velocity limit.

    velocity: velocity at the start [ticks/ms]. fastest, hardest: as returned by `profile`.
    """
    if not hardest:
        return _RECTANGLE
    return _TRAPEZOID if fastest**2 <= hardest * abs(away) + 0.5 * velocity**2 else _TRIANGLE
