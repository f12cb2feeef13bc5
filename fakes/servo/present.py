"""A servo's measurements of its joint, stored in ticks in its "present" registers."""

import math
from collections.abc import Callable
from random import Random
from struct import Struct

from hil.drivers.packet import StatusError
from hil.fakes.servo.controller import POSITION_MODE
from hil.fakes.servo.encoder import Reading
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.registers import TICKS_PER_TURN, VELOCITY_UNIT_RPM, EmulatedModel

PRESENT_START = 120
PRESENT_END = 147
"""End address (exclusive) of the present registers, which begin at `PRESENT_START`."""

STATE_START = 126
STATE_END = 136
"""End address (exclusive) of Present Current, Velocity and Position, which begin at `STATE_START`."""

_TICKS_PER_RAD = TICKS_PER_TURN / math.tau
_TICKS_PER_RAD_S = 60 / math.tau / VELOCITY_UNIT_RPM
_REALTIME_TICK_WRAP = 32_768
_REVERSE = 0x01  # bit of Drive Mode
_MOST_HOMING_TICKS = 1024
"""Largest Homing Offset [ticks] that Position Control Mode applies; it ignores larger ones (e-Manual, Homing Offset).
"""
_CLEAR_TURNS = b"\x01DXL\x22"

# Realtime Tick, Moving, Moving Status, Present PWM; Present Current (or Load), Velocity, Position; the trajectories.
_BEFORE = Struct("<HBBh")
_STATE = Struct("<hii")
_TRAJECTORIES = Struct("<ii")

Share = Callable[[float, float], float]


class Present:
    """Encoder, current sensor and clock of one servo."""

    def __init__(
        self,
        memory: Memory,
        model: EmulatedModel,
        zero_ticks: int,
        direction: int,
        clock_rate: float,
        current_noise_a: float,
        noise: Random | None,
        encoder: Reading,
        senses_supply: bool,
    ) -> None:
        self.zero_ticks = zero_ticks
        self.direction = direction
        self.sign = direction
        """+1 or -1: sign of the servo's position, velocity, current and PWM relative to the joint's."""
        self.jump_ticks = 0
        """Encoder error injected by a fault [ticks]."""
        self._memory = memory
        self._model = model
        self._clock_rate = clock_rate
        self._noise_a = current_noise_a
        self._noise = noise
        self._unit = model.current_unit_a
        self._encoder = encoder
        self._encoder_is_perfect = encoder.is_perfect
        self._senses_supply = senses_supply
        self._imperfect = noise is not None or senses_supply
        self._booted_at = 0.0
        self._turn_ticks = 0
        """Offset that the servo adds to its encoder count [ticks]; Reverse Mode negates the sum."""
        self._shift = 0
        self._reversed = False
        self._moving_threshold = 0
        self._share: Share = lambda current, velocity: 0.0
        registers = model.registers
        self._is_x_series = "Present Position" in registers and registers["Present Position"].address == 132

    def derive(self, share: Share) -> None:
        """Update the values that depend on registers.

        share: returns the bridge's duty cycle for a current [A] and a velocity [rad/s].
        """
        self._reversed = bool(self._memory.get("Drive Mode") & _REVERSE)
        self.sign = -self.direction if self._reversed else self.direction
        self._moving_threshold = self._memory.get("Moving Threshold")
        self._share = share
        self._shift_changed()

    def power_up(self, now: float, position: float) -> None:
        """Start counting time and turns at `now` [s] and `position` [rad]."""
        self._booted_at = now
        self.forget_turns(position)

    def clear(self, body: bytes, moving: bool, position: float) -> int:
        """Execute the instruction Clear (reset the turn count); return the error number.

        It is uncertain whether real servos return the same error numbers, except for Result Fail.
        """
        if len(body) != len(_CLEAR_TURNS):
            return StatusError.DATA_LENGTH
        if body != _CLEAR_TURNS:
            return StatusError.DATA_RANGE
        if moving:
            return StatusError.RESULT_FAIL
        self.forget_turns(position)
        return StatusError.NONE

    def ticks(self, position: float) -> float:
        """Return Present Position [ticks] for a joint angle [rad], before rounding and without noise."""
        ticks = self._encoder.steady(self.zero_ticks + self.direction * position * _TICKS_PER_RAD)
        return (TICKS_PER_TURN - ticks if self._reversed else ticks) + self._shift

    def angle(self, ticks: float) -> float:
        """Return the joint angle [rad] for a Present Position [ticks]."""
        ticks -= self._shift
        if self._reversed:
            ticks = TICKS_PER_TURN - ticks
        return self.direction * (ticks - self.zero_ticks) / _TICKS_PER_RAD

    def velocity_ticks(self, velocity: float) -> float:
        """Return Present Velocity at a joint velocity [rad/s], before rounding."""
        return self.sign * velocity * _TICKS_PER_RAD_S

    def moves(self, velocity: float) -> bool:
        """Return whether Moving is 1 at a joint velocity [rad/s]."""
        return abs(round(self.velocity_ticks(velocity))) > self._moving_threshold

    def state(self, position: float, velocity: float, current: float) -> bytes:
        """Return registers 126 to 135 for a joint angle [rad], velocity [rad/s] and motor current [A]."""
        sign = self.sign
        unit = self._unit
        ticks = 0
        if unit:
            if self._imperfect:
                current = self._sensed(current, velocity)
            ticks = round(sign * current / unit)
            if ticks > 32_767 or ticks < -32_768:
                ticks = -32_768 if ticks < 0 else 32_767
        angle = self.zero_ticks + self.direction * position * _TICKS_PER_RAD
        encoder = round(angle if self._encoder_is_perfect else self._encoder.sample(angle))
        if self._reversed:
            encoder = TICKS_PER_TURN - encoder
        return _STATE.pack(ticks, round(sign * velocity * _TICKS_PER_RAD_S), encoder + self._shift + self.jump_ticks)

    def measure(self, address: int, end: int, now: float, position: float, velocity: float, current: float) -> None:
        """Update the present registers in an address range with the joint's state at `now` [s]."""
        if not self._is_x_series:
            self._measure_other(now, position)
            return
        data = self._memory.data
        data[STATE_START:STATE_END] = self.state(position, velocity, current)
        if address < STATE_START or end > STATE_END:
            tick = int((now - self._booted_at) * self._clock_rate * 1000) % _REALTIME_TICK_WRAP
            pwm = round(885 * self._share(self.sign * current, self.sign * velocity))
            _BEFORE.pack_into(data, PRESENT_START, tick, self.moves(velocity), data[123], pwm)

    def tell_trajectory(self, status: int, velocity_ticks: float, position_ticks: float) -> None:
        """Set Moving Status and the two trajectory registers."""
        data = self._memory.data
        data[123] = status
        _TRAJECTORIES.pack_into(data, STATE_END, round(velocity_ticks), round(position_ticks))

    def _sensed(self, current: float, velocity: float) -> float:
        """Return the output of the current sensor for a motor current [A] and a velocity [rad/s]."""
        if self._noise is not None:
            current += self._noise.gauss(0.0, self._noise_a)
        if self._senses_supply:
            current *= abs(self._share(current, velocity))
        return current

    def _measure_other(self, now: float, position: float) -> None:
        """Update Realtime Tick and Present Position of a model outside the X series (in ticks of X-series encoders)."""
        register = self._model.registers.get("Present Position")
        if register is not None and register.size == 4:
            self._memory.store(register, round(self.ticks(position)))
        tick = int((now - self._booted_at) * self._clock_rate * 1000) % _REALTIME_TICK_WRAP
        self._memory.set("Realtime Tick", tick)

    def forget_turns(self, position: float) -> None:
        """Make Present Position start within one turn (before Homing Offset is added) at this joint angle [rad]."""
        self._turn_ticks = 0
        self._shift_changed()
        raw = round(self.ticks(position)) - self._homing_ticks()
        turns = -(raw // TICKS_PER_TURN) * TICKS_PER_TURN
        self._turn_ticks = -turns if self._reversed else turns
        self._shift_changed()

    def _homing_ticks(self) -> int:
        offset = self._memory.get("Homing Offset")
        ignored = abs(offset) > _MOST_HOMING_TICKS and self._memory.get("Operating Mode") == POSITION_MODE
        return 0 if ignored else offset

    def _shift_changed(self) -> None:
        turns = -self._turn_ticks if self._reversed else self._turn_ticks
        self._shift = turns + self._homing_ticks()
