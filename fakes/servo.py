"""One fake servo: a control table as a state machine. It knows no bus and no plant; `fakes.bus` gives it both.

What it does is written in the ROBOTIS e-Manual (protocol2 and x/<model> pages). Where the manual is silent this
module decides as follows, choosing what asks more of a client:

- A write that covers several registers is checked as a whole; if one refuses, none is written.
- A write must begin and end on register boundaries: in the middle of a register it is a Data Length error, at an
  undefined address an Access error. A read may begin inside a register; undefined bytes between two registers read 0,
  and a read that begins or ends at an undefined address is an Access error.
- A goal beyond its limit register is refused with Data Limit (some firmware may clamp instead).
- When the Bus Watchdog trips, Goal Current becomes 0 and torque stays enabled. While tripped, only 0 may be written
  to it.
- After a shutdown, a write of 1 to Torque Enable is answered without an error number but leaves torque off.
- At power-up, as after a change of Operating Mode, Goal Current is Current Limit: a client that enables torque in
  current mode without writing a goal first gets full current.
- Reverse mode (Drive Mode bit 0) mirrors Present Position about half a turn.

A model without a current sensor (XL430-W250) has no current mode and reads a Present Load of 0.

Only current control mode moves the motor. In the other operating modes every register can be written and read and
Torque Enable reads back 1, but the motor gets no current.
"""

import math
from collections.abc import Callable, Mapping
from struct import Struct

from drivers.packet import ALERT, HardwareError, Instruction, StatusError
from fakes.registers import (
    BAUD_RATES,
    TICKS_PER_TURN,
    VELOCITY_UNIT_RPM,
    Model,
    Register,
)

CURRENT_MODE = 0
POSITION_MODE = 3

BOOT_S = 0.25
"""How long a servo is deaf after Reboot [s]. Unsure: the manual gives no figure; clients in use wait 0.3 to 1 s."""

WATCHDOG_UNIT_S = 0.020
WATCHDOG_TRIPPED = 0xFF

_TICKS_PER_RAD = TICKS_PER_TURN / math.tau
_TICKS_PER_RAD_S = 60 / math.tau / VELOCITY_UNIT_RPM
_MULTI_TURN_LIMIT_TICKS = 256 * TICKS_PER_TURN
_REALTIME_TICK_WRAP = 32_768

# Drive Mode
_REVERSE = 0x01
_TORQUE_ON_BY_GOAL_UPDATE = 0x08

_GOALS = frozenset({"Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"})
_LIMIT_OF_GOAL = {"Goal PWM": "PWM Limit", "Goal Current": "Current Limit", "Goal Velocity": "Velocity Limit"}
_GAINS = (
    "Velocity I Gain",
    "Velocity P Gain",
    "Position D Gain",
    "Position I Gain",
    "Position P Gain",
    "Feedforward 2nd Gain",
    "Feedforward 1st Gain",
)

# Realtime Tick, Moving, Moving Status, Present PWM, Present Current (or Load), Velocity, Position: 120..135.
_PRESENT = Struct("<HBBhhii")
PRESENT_START = 120
PRESENT_END = 147
_GOAL_CURRENT = 102


class Servo:
    """A servo on its own: registers, what may be done to them, and what the motor is told to do.

    Times are seconds on the bus's clock. `direction` is -1 where the servo turns against its joint; `zero_ticks` is the
    Present Position (Homing Offset 0) at which the joint's angle is 0.
    """

    def __init__(
        self,
        model: Model,
        servo_id: int,
        *,
        zero_ticks: int = 0,
        direction: int = 1,
        firmware: int = 48,
        baud: int = 1_000_000,
        return_delay_us: int = 0,
        input_voltage_v: float | None = None,
        temperature_c: float = 35.0,
        registers: Mapping[str, int] | None = None,
    ) -> None:
        self.model = model
        self.zero_ticks = zero_ticks
        self.direction = direction
        self.firmware = firmware
        self.connected = True
        """False: its bus cable is out. It hears nothing and says nothing; its motor does as last told."""
        self.heard_at = 0.0
        """When the last instruction packet reached it [s]; the Bus Watchdog counts from here."""
        self.ready_at = 0.0
        """When it has booted [s]; deaf before."""
        self._input_voltage_v = model.nominal_voltage_v if input_voltage_v is None else input_voltage_v
        self._temperature_c = temperature_c
        self._booted_at = 0.0
        self._turn_ticks = 0
        self._registered: bytes | None = None
        self._registers = model.registers
        self._starting_at = {register.address: register for register in model.registers.values()}
        self._end = max(register.address + register.size for register in model.registers.values())
        self._memory = bytearray(self._end)
        self._readable: set[tuple[int, int]] = set()
        self._after: dict[str, Callable[[], None]] = {
            "Torque Enable": self._torque_enable_written,
            "Operating Mode": self._operating_mode_written,
            "Max Voltage Limit": self._check_health,
            "Min Voltage Limit": self._check_health,
            "Temperature Limit": self._check_health,
            "Shutdown": self._shut_down_if_masked,
        }
        eeprom = {
            "Model Number": model.number,
            "Firmware Version": firmware,
            "ID": servo_id,
            "Baud Rate": BAUD_RATES.index(baud),
            "Return Delay Time": return_delay_us // 2,
        } | dict(registers or {})
        for register in model.registers.values():
            self._store(register, eeprom.get(register.name, register.initial))
        self._reset_goals()
        self._derive()

    # What the motor and the bus ask of it

    def power_up(self, now: float, position: float, boot_s: float = 0.0) -> None:
        """Start afresh at time `now` [s] with the joint at `position` [rad]; deaf for `boot_s`.

        The RAM area takes its initial values, torque is off, errors are gone, and the count of turns is lost: Present
        Position starts within one turn (before Homing Offset).
        """
        for register in self._registers.values():
            if not register.eeprom:
                self._store(register, register.initial)
        self._registered = None
        self._booted_at = now
        self.ready_at = now + boot_s
        self.heard_at = now
        self._turn_ticks = 0
        self._turn_ticks = -(self._position_ticks(position) // TICKS_PER_TURN) * TICKS_PER_TURN
        self._reset_goals()
        self._check_health()
        self._derive()

    def hears(self, now: float, baud: int) -> bool:
        """Whether a packet at this baud that ends at `now` [s] is understood."""
        return self.baud == baud and self.connected and now >= self.ready_at

    def measure(self, now: float, position: float, velocity: float, current: float) -> None:
        """Put the joint's angle [rad], velocity [rad/s] and motor current [A] at `now` into the present registers."""
        sign = self._sign
        unit = self.model.current_unit_a
        velocity_ticks = round(sign * velocity * _TICKS_PER_RAD_S)
        _PRESENT.pack_into(
            self._memory,
            PRESENT_START,
            int((now - self._booted_at) * 1000) % _REALTIME_TICK_WRAP,
            abs(velocity_ticks) > self._moving_threshold,
            0,
            0,
            _clip_16(round(sign * current / unit)) if unit else 0,
            velocity_ticks,
            self._position_ticks(position) + self._turn_ticks + self._homing_offset,
        )

    def trip_watchdog(self) -> None:
        """The Bus Watchdog's time is over: stop the motor and refuse goals until 0 is written to the register."""
        self._set("Bus Watchdog", WATCHDOG_TRIPPED)
        for name in ("Goal Current", "Goal PWM", "Goal Velocity"):
            if name in self._registers:
                self._set(name, 0)
        self._derive()

    def fail(self, error: HardwareError) -> None:
        """Set bits of Hardware Error Status; those in the Shutdown mask turn torque off. Only Reboot clears them."""
        self._set("Hardware Error Status", self.value("Hardware Error Status") | error)
        self._shut_down_if_masked()
        self._derive()

    # What a test asks of it

    def value(self, name: str) -> int:
        """The register's present content; KeyError when the model has no such register."""
        register = self._registers[name]
        raw = self._memory[register.address : register.address + register.size]
        return int.from_bytes(raw, "little", signed=register.signed)

    @property
    def torque_enabled(self) -> bool:
        return self.value("Torque Enable") == 1

    @property
    def operating_mode(self) -> int:
        return self.value("Operating Mode")

    @property
    def goal_current_ticks(self) -> int:
        return self.value("Goal Current")

    @property
    def watchdog_tripped(self) -> bool:
        return self.value("Bus Watchdog") == WATCHDOG_TRIPPED

    @property
    def hardware_error(self) -> HardwareError:
        return HardwareError(self.value("Hardware Error Status"))

    @property
    def input_voltage_v(self) -> float:
        return self._input_voltage_v

    @input_voltage_v.setter
    def input_voltage_v(self, volt: float) -> None:
        self._input_voltage_v = volt
        self._check_health()
        self._derive()

    @property
    def temperature_c(self) -> float:
        return self._temperature_c

    @temperature_c.setter
    def temperature_c(self, celsius: float) -> None:
        self._temperature_c = celsius
        self._check_health()
        self._derive()

    # Instructions

    def execute(self, instruction: int, body: bytes, now: float, position: float) -> tuple[int, bytes]:
        """Act on an instruction addressed to this servo; the error number (Alert bit aside) and the data of its status.

        Read is not among them: the bus answers it with `read`, after `measure`.
        """
        if instruction in (Instruction.WRITE, Instruction.REG_WRITE) and len(body) < 3:
            return StatusError.DATA_LENGTH, b""
        data = b""
        error: int = StatusError.NONE
        match instruction:
            case Instruction.PING:
                data = bytes(self._memory[0:2] + self._memory[6:7])
            case Instruction.WRITE:
                error = self.write(body[0] | body[1] << 8, body[2:])
            case Instruction.REG_WRITE:
                error = self._register_write(body)
            case Instruction.ACTION:
                error = self._act()
            case Instruction.REBOOT:
                self.power_up(now, position, BOOT_S)
            case _:
                error = StatusError.INSTRUCTION
        return error, data

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error number and bytes of a stretch of the control table."""
        if (address, length) not in self._readable:
            if not self._can_read(address, length):
                return StatusError.ACCESS, b""
            self._readable.add((address, length))  # the answer never changes
        return StatusError.NONE, bytes(self._memory[address : address + length])

    def write(self, address: int, data: bytes) -> int:
        """Write a stretch of the control table; the error number."""
        if address == _GOAL_CURRENT and len(data) == 2 and self._takes_goal_current:
            return self._write_goal_current(data)
        writes, error = self._split(address, data)
        for register, value in writes:
            error = error or self._refusal(register, value)
        if error:
            return error
        for register, value in writes:
            self._store(register, value)
            if register.name in self._after:
                self._after[register.name]()
            if register.name in _GOALS and self.value("Drive Mode") & _TORQUE_ON_BY_GOAL_UPDATE:
                self._store(self._registers["Torque Enable"], 1)
                self._torque_enable_written()
        self._derive()
        return StatusError.NONE

    def _write_goal_current(self, data: bytes) -> int:
        """The write that a control cycle makes, with the same outcome as the long way round."""
        ticks = int.from_bytes(data, "little", signed=True)
        limit = self._current_limit
        if ticks > limit or ticks < -limit:
            return StatusError.DATA_LIMIT
        self._memory[_GOAL_CURRENT : _GOAL_CURRENT + 2] = data
        if self._driven:
            self.motor_current_a = ticks * self._current_per_tick
        return StatusError.NONE

    def _split(self, address: int, data: bytes) -> tuple[list[tuple[Register, int]], int]:
        """The registers that a write covers with their values, and the error if it does not fit them."""
        writes: list[tuple[Register, int]] = []
        at, end = address, address + len(data)
        while at < end:
            register = self._starting_at.get(at)
            if register is None:
                inside = at < self._end and any(r.address < at < r.address + r.size for r in self._registers.values())
                return writes, StatusError.DATA_LENGTH if inside else StatusError.ACCESS
            if at + register.size > end:
                return writes, StatusError.DATA_LENGTH
            raw = data[at - address : at - address + register.size]
            writes.append((register, int.from_bytes(raw, "little", signed=register.signed)))
            at += register.size
        return writes, StatusError.NONE

    def _refusal(self, register: Register, value: int) -> int:
        """Why this value may not be written to this register now; 0 when it may."""
        name = register.name
        if not register.writable or (register.eeprom and self.torque_enabled):
            return StatusError.ACCESS
        in_range = register.minimum <= value <= register.maximum
        if name == "Operating Mode":
            in_range = value in self.model.operating_modes
        if self.watchdog_tripped and (name in _GOALS or (name == "Bus Watchdog" and value != 0)):
            in_range = False
        if not in_range:
            return StatusError.DATA_RANGE
        within = True
        if name in _LIMIT_OF_GOAL:
            within = abs(value) <= self.value(_LIMIT_OF_GOAL[name])
        elif name == "Goal Position":
            within = self._goal_position_allowed(value)
        return StatusError.NONE if within else StatusError.DATA_LIMIT

    def _goal_position_allowed(self, ticks: int) -> bool:
        if self.operating_mode == POSITION_MODE:
            return self.value("Min Position Limit") <= ticks <= self.value("Max Position Limit")
        return abs(ticks) < _MULTI_TURN_LIMIT_TICKS

    def _can_read(self, address: int, length: int) -> bool:
        defined = {a for r in self._registers.values() for a in range(r.address, r.address + r.size)}
        return length > 0 and address in defined and address + length - 1 in defined

    def _register_write(self, body: bytes) -> int:
        writes, error = self._split(body[0] | body[1] << 8, body[2:])
        for register, value in writes:
            error = error or self._refusal(register, value)
        if not error:
            self._registered = body
            self._set("Registered Instruction", 1)
        return error

    def _act(self) -> int:
        body, self._registered = self._registered, None
        if body is None:
            return StatusError.INSTRUCTION
        self._set("Registered Instruction", 0)
        return self.write(body[0] | body[1] << 8, body[2:])

    # What follows from a write

    def _torque_enable_written(self) -> None:
        self._shut_down_if_masked()

    def _operating_mode_written(self) -> None:
        self._reset_goals()
        for name in _GAINS:
            self._store(self._registers[name], self._registers[name].initial)

    def _reset_goals(self) -> None:
        for goal, limit in _LIMIT_OF_GOAL.items():
            if goal in self._registers:
                self._set(goal, self.value(limit))

    def _check_health(self) -> None:
        """Compare supply and temperature with their limits; what is found stays in Hardware Error Status."""
        decivolt, celsius = round(10 * self._input_voltage_v), round(self._temperature_c)
        self._set("Present Input Voltage", decivolt)
        self._set("Present Temperature", celsius)
        error = self.value("Hardware Error Status")
        if not self.value("Min Voltage Limit") <= decivolt <= self.value("Max Voltage Limit"):
            error |= HardwareError.INPUT_VOLTAGE
        if celsius > self.value("Temperature Limit"):
            error |= HardwareError.OVERHEATING
        self._set("Hardware Error Status", error)
        self._shut_down_if_masked()

    def _shut_down_if_masked(self) -> None:
        if self.value("Hardware Error Status") & self.value("Shutdown"):
            self._set("Torque Enable", 0)

    def _derive(self) -> None:
        """Work out once, after any change, what every packet asks for."""
        self.id = self.value("ID")
        self.baud = BAUD_RATES[self.value("Baud Rate")]
        self.return_delay_s = 2e-6 * self.value("Return Delay Time")
        self.status_return_level = self.value("Status Return Level")
        self.alert = ALERT if self.value("Hardware Error Status") else 0
        watchdog = self.value("Bus Watchdog")
        counting = self.torque_enabled and watchdog != WATCHDOG_TRIPPED
        self.watchdog_s = watchdog * WATCHDOG_UNIT_S if counting else 0.0
        """Silence after which the watchdog trips [s]; 0 when it does not count."""

        self._reversed = bool(self.value("Drive Mode") & _REVERSE)
        self._sign = -self.direction if self._reversed else self.direction
        self._homing_offset = self.value("Homing Offset")
        self._moving_threshold = self.value("Moving Threshold")
        self._current_per_tick = self._sign * self.model.current_unit_a
        self._driven = self.torque_enabled and self.operating_mode == CURRENT_MODE
        self.motor_current_a = 0.0
        """Current that the motor is told to carry, in the joint's direction [A]."""
        if self._driven:
            self.motor_current_a = self.goal_current_ticks * self._current_per_tick
        self._current_limit: int = self.value("Current Limit") if "Goal Current" in self._registers else -1
        by_goal = self.value("Drive Mode") & _TORQUE_ON_BY_GOAL_UPDATE
        self._takes_goal_current = self._current_limit >= 0 and not by_goal and not self.watchdog_tripped

    def _position_ticks(self, position: float) -> int:
        ticks = round(self.zero_ticks + self.direction * position * _TICKS_PER_RAD)
        return TICKS_PER_TURN - ticks if self._reversed else ticks

    def _set(self, name: str, value: int) -> None:
        self._store(self._registers[name], value)

    def _store(self, register: Register, value: int) -> None:
        end = register.address + register.size
        self._memory[register.address : end] = value.to_bytes(register.size, "little", signed=register.signed)


def _clip_16(value: int) -> int:
    return max(-32_768, min(32_767, value))
