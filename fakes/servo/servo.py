"""One fake servo: a control table as a state machine, independent of bus and plant (see `hil.fakes.bus.bus`).

The behaviour follows the ROBOTIS e-Manual (protocol2 and x/<model> pages). Where the manual is silent, the fake chooses
the behaviour that demands more of a client: see "Conformance" in docs/fake-bus.md. Moreover:

- A write must begin and end on register boundaries. A write that begins or ends inside a writable register causes a
  Data Length error; other violations cause an Access error. A read may begin inside a register; undefined bytes between
  two registers read as 0. A read that begins or ends at an undefined address causes an Access error.
- When the Bus Watchdog trips, the goal of the operating mode stops the motor: Goal Current, Goal PWM or Goal Velocity
  becomes 0, or Goal Position becomes Present Position, which the servo continues to hold. Goals that only act as limits
  in this mode keep their values, and torque stays enabled. The register Bus Watchdog then accepts only 0.
- At power-up, and after a change of Operating Mode, Goal Current and Goal PWM equal their limits: if a client enables
  torque in current mode without first writing a goal, full current flows. Goal Velocity is 0.

A model without a current sensor (XL430-W250) has no current mode and reports a Present Load of 0.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random

from hil.drivers.packet import ALERT, HardwareError, Instruction, StatusError
from hil.fakes.servo.backup import Backup, factory_reset
from hil.fakes.servo.controller import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    FULL_PWM,
    GOAL_OF_MODE,
    POSITION_MODE,
    POSITION_MODES,
    Controller,
    Goals,
    obeyed_current,
)
from hil.fakes.servo.encoder import PERFECT, Encoder, Reading
from hil.fakes.servo.health import Health, Overload, Thermal
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.power import Powered
from hil.fakes.servo.present import Present
from hil.fakes.servo.registers import BAUD_RATES, EmulatedModel, Register
from hil.fakes.servo.write_rules import GAINS, GOALS, LIMIT_OF_GOAL, PROFILE, WATCHDOG_TRIPPED, refusal

BOOT_S = 0.25
"""Time after Reboot during which a servo does not respond [s].

Uncertain: the manual gives no figure; existing clients wait 0.3 to 1 s.
"""

WATCHDOG_UNIT_S = 0.020

_NO_SHADOW_ID = 253
_GOAL_PWM = 100
_GOAL_CURRENT = 102

_TORQUE_ON_BY_GOAL_UPDATE = 0x08  # bit of Drive Mode

# Startup Configuration
_TORQUE_ON_AT_BOOT = 0x01
_RESTORE_AT_BOOT = 0x02


class EmulatedServo(Powered):
    """A servo without bus or plant: its registers, the rules for accessing them, and the resulting motor command.

    Times are in seconds on the bus's clock. `hil.fakes.description.FakeServo` documents the arguments.
    """

    def __init__(
        self,
        model: EmulatedModel,
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
        current_noise_a: float = 0.0,
        encoder: Encoder = PERFECT,
        senses_supply: bool | None = None,
        clock_error_ppm: float = 0.0,
        voltage_limited: bool = False,
        thermal: Thermal | None = None,
        overload: Overload | None = None,
        seed: int = 0,
    ) -> None:
        supply_v = model.nominal_voltage_v if input_voltage_v is None else input_voltage_v
        health = Health(model.resistance_ohm, temperature_c, thermal, overload)
        super().__init__(model, Memory(model), health, supply_v)
        self.firmware = firmware
        self.has_fast_reads = firmware >= model.fast_read_firmware
        """Whether the servo supports Fast Sync Read, Fast Bulk Read and Control Table Backup."""
        self.connected = True
        """False if the bus cable is disconnected: the servo then neither receives nor replies, and its motor
        continues to follow the last command.
        """
        self.heard_at = 0.0
        """Time at which the servo received its last instruction packet [s]; the Bus Watchdog counts from then."""
        self.ready_at = 0.0
        """Time at which the servo finishes booting [s]; it does not respond before then."""
        self.present = Present(
            *(self.memory, model, zero_ticks, direction, 1.0 + 1e-6 * clock_error_ppm, current_noise_a),
            Random(f"current {seed} {servo_id}") if current_noise_a else None,
            Reading(encoder, f"encoder {seed} {servo_id}"),
            model.senses_supply if senses_supply is None else senses_supply,
        )
        self.controller = Controller()
        self.motor_current_a = 0.0
        """Commanded motor current, in the joint's direction [A]."""
        self._applied_share: float | None = None
        """Duty cycle that the servo's loop applied last; None if the loop does not control the current."""
        self._voltage_limited = voltage_limited
        self._set_baud = baud
        self._registered: bytes | None = None
        self._backup = Backup()
        self._angle: Callable[[], float] = lambda: 0.0
        self.changed: Callable[[], None] = lambda: None
        """Called after any change that affects the bus: ID, baud rate, need for ticks."""
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
            self.memory.store(register, eeprom.get(register.name, register.initial))
        self._reset_goals()
        self._derive()

    # Interface to the bus

    def power_up(self, now: float, angle: Callable[[], float], boot_s: float = 0.0) -> None:
        """Power up at time `now` [s]; the servo does not respond for `boot_s` [s].

        angle: function that returns the joint's present position [rad]; it is kept and called again later.
        RAM registers take their initial values, or those of the backup if Startup Configuration selects it; the XL320's
        Torque Limit is set to Max Torque. Torque is off, and errors are cleared. The turn count is lost: Present
        Position starts within one turn (before Homing Offset).
        """
        memory = self.memory
        for register in memory.registers.values():
            if not register.eeprom:
                memory.store(register, register.initial)
        if "Torque Limit" in memory.registers:  # XL320
            memory.set("Torque Limit", memory.get("Max Torque"))
        startup = memory.get("Startup Configuration")
        self._backup.mark(memory)
        if startup & _RESTORE_AT_BOOT:
            self._backup.restore(memory, eeprom=False)
        memory.follow_indirect_addresses()
        self._registered = None
        self._angle = angle
        self.ready_at = now + boot_s
        self.heard_at = now
        self.health.rest()
        self._derive()
        self.present.power_up(now, angle())
        self._reset_goals()
        memory.set("Torque Enable", startup & _TORQUE_ON_AT_BOOT)
        self._check_health()
        self._derive()
        self.controller.start(self.present.ticks(angle()))

    def reboot(self, now: float, boot_s: float = BOOT_S) -> None:
        """Switch the servo off and on again, as the Reboot instruction or a dip in its supply voltage does."""
        self.power_up(now, self._angle, boot_s)

    def hears(self, now: float, baud: int) -> bool:
        """Return whether the servo receives a packet that is sent at this baud rate and ends at `now` [s]."""
        return self.baud == baud and self.connected and now >= self.ready_at

    def trip_watchdog(self) -> None:
        """Trip the Bus Watchdog: stop the motor and refuse goals until 0 is written to the register."""
        memory = self.memory
        memory.set("Bus Watchdog", WATCHDOG_TRIPPED)
        for name in PROFILE:
            memory.set(name, 0)
        if self._mode in POSITION_MODES:
            self._hold_position()
        elif self._mode in GOAL_OF_MODE:
            memory.set(GOAL_OF_MODE[self._mode], 0)
            self.controller.start(self.present.ticks(self._angle()))
        self._derive()

    def fail(self, error: HardwareError) -> None:
        """Set bits of Hardware Error Status; those in the Shutdown mask turn torque off. Only Reboot clears them."""
        self.memory.set("Hardware Error Status", self.memory.get("Hardware Error Status") | error)
        self._shut_down_if_masked()
        self._derive()

    def tick(self, step_s: float, position: float, velocity: float, current: float, rotor_velocity: float) -> None:
        """Run one period of the servo's own loop: heating, overload and motor control.

        step_s: period [s]. position, velocity, current: state of the joint [rad, rad/s, A]. rotor_velocity: velocity of
        the rotor, referred to the joint [rad/s].
        """
        if self.health.changes:
            if self.health.step(step_s, current) and not self.hardware_error & HardwareError.OVERLOAD:
                self.fail(HardwareError.OVERLOAD)
            differs = round(self.health.temperature_c) != self.memory.get("Present Temperature")
            if differs or not self.health.changes:  # a servo that has cooled down needs no more ticks
                self._check_health()
                self._derive()
        if not self._torque:
            return
        if self._mode != CURRENT_MODE or self._is_limited:
            ticks = self.present.ticks(position)
            sign = self.present.sign
            turning = sign * rotor_velocity
            wanted = self.controller.motor_current(self.model, self.supply_v, ticks, sign * velocity, turning)
            self.motor_current_a = sign * wanted
            self._applied_share = self.supply_share(wanted, turning)
            self.present.tell_trajectory(*self.controller.state(ticks))

    # Queries for tests

    def value(self, name: str) -> int:
        return self.memory.value(name)

    @property
    def direction(self) -> int:
        return self.present.direction

    @property
    def torque_enabled(self) -> bool:
        return self.memory.get("Torque Enable") == 1

    @property
    def operating_mode(self) -> int:
        return self.memory.get("Operating Mode")

    @property
    def goal_current_ticks(self) -> int:
        return obeyed_current(self.memory)

    @property
    def watchdog_tripped(self) -> bool:
        return self.memory.get("Bus Watchdog") == WATCHDOG_TRIPPED

    @property
    def hardware_error(self) -> HardwareError:
        return HardwareError(self.memory.get("Hardware Error Status"))

    # Instructions

    def execute(
        self, instruction: int, body: bytes, now: float, moving: bool, *, shadow: bool = False
    ) -> tuple[int, bytes]:
        """Execute an instruction addressed to this servo; return the error number and data of the status packet.

        The error number excludes the Alert bit. shadow: whether the instruction was addressed to the Secondary ID. The
        instruction Read is not handled here: the bus calls `read` after updating the measurements.
        """
        if instruction in (Instruction.WRITE, Instruction.REG_WRITE) and len(body) < 3:
            return StatusError.DATA_LENGTH, b""
        data = b""
        error: int = StatusError.NONE
        match instruction:
            case Instruction.PING:
                data = self.model.number.to_bytes(2, "little") + bytes((self.firmware,))
            case Instruction.WRITE:
                address = body[0] | body[1] << 8
                error = self.write_as_shadow(address, body[2:]) if shadow else self.write(address, body[2:])
            case Instruction.REG_WRITE:
                error = self._register_write(body, shadow)
            case Instruction.ACTION:
                error = self._act()
            case Instruction.REBOOT:
                self.reboot(now)
            case Instruction.FACTORY_RESET | Instruction.CONTROL_TABLE_BACKUP if shadow:
                error = StatusError.ACCESS
            case Instruction.FACTORY_RESET:
                error = factory_reset(self.memory, body)
                if not error:
                    self.reboot(now)
            case Instruction.CLEAR:
                error = self._clear_turns(body, moving)
            case Instruction.CONTROL_TABLE_BACKUP if self.has_fast_reads:
                error = self._backup.execute(self.memory, body)
                self._derive()
            case _:
                error = StatusError.INSTRUCTION
        return error, data

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the error number and the bytes of a range of the control table."""
        data = self.memory.read(address, length)
        return (StatusError.NONE, data) if data is not None else (StatusError.ACCESS, b"")

    def write(self, address: int, data: bytes) -> int:
        """Write a range of the control table; return the error number."""
        # For the goals written in control cycles, there is a fast path with the same result as the general one.
        if address == _GOAL_PWM and len(data) == 2 and self._goal_pwm_limit >= 0:
            return self._write_goal_pwm(data)
        if address != _GOAL_CURRENT or len(data) != 2 or not self._takes_goal_current:
            return self._write_stretch(address, data, shadow=False)
        ticks = int.from_bytes(data, "little", signed=True)
        limit = self._current_limit
        if ticks > limit or ticks < -limit:
            return StatusError.DATA_LIMIT
        self.memory.data[_GOAL_CURRENT : _GOAL_CURRENT + 2] = data
        if self._driven:
            self.motor_current_a = ticks * self._current_per_tick
        return StatusError.NONE

    def _write_goal_pwm(self, data: bytes) -> int:
        ticks = int.from_bytes(data, "little", signed=True)
        if abs(ticks) > self._goal_pwm_limit:
            return StatusError.DATA_LIMIT
        self.memory.data[_GOAL_PWM : _GOAL_PWM + 2] = data
        if self.needs_ticks and self.controller.goals is not None:
            self.controller.goals = replace(self.controller.goals, pwm=ticks)
        return StatusError.NONE

    def write_as_shadow(self, address: int, data: bytes) -> int:
        """Write a range of the control table, as requested through the Secondary ID; return the error number."""
        return self._write_stretch(address, data, shadow=True)

    def _write_stretch(self, address: int, data: bytes, *, shadow: bool) -> int:
        writes, error = self.memory.split(address, data)
        if error:
            return error
        for register, value in writes:
            refused = refusal(self.memory, self.model, register, value, shadow)
            if not refused:
                self._write(register, value)
            error = error or refused
        self._derive()
        return error

    def _write(self, register: Register, value: int) -> None:
        self.memory.store(register, value)
        name = register.name
        if name in self._after:
            self._after[name]()
        elif name.startswith("Indirect Address"):
            self.memory.follow_indirect_addresses()
        if name in GOALS and self.memory.get("Drive Mode") & _TORQUE_ON_BY_GOAL_UPDATE and not self.torque_enabled:
            self.memory.set("Torque Enable", 1)
            self._forget_turns_in_position_mode()
            self._shut_down_if_masked()

    def _register_write(self, body: bytes, shadow: bool) -> int:
        writes, error = self.memory.split(body[0] | body[1] << 8, body[2:])
        for register, value in writes:
            error = error or refusal(self.memory, self.model, register, value, shadow)
        if not error:
            self._registered = body
            self.memory.set("Registered Instruction", 1)
        return error

    def _act(self) -> int:
        body, self._registered = self._registered, None
        if body is None:
            return StatusError.INSTRUCTION
        self.memory.set("Registered Instruction", 0)
        return self.write(body[0] | body[1] << 8, body[2:])

    def _clear_turns(self, body: bytes, moving: bool) -> int:
        """Execute Clear: shift Present Position, Goal Position and trajectory by the same number of turns."""
        before = self.present.ticks(self._angle())
        if error := self.present.clear(body, moving, self._angle()):
            return error
        turned = round(self.present.ticks(self._angle()) - before)
        if turned:
            self.memory.set("Goal Position", self.memory.get("Goal Position") + turned)
            self.controller.shift(turned)
            self._derive()
        return StatusError.NONE

    # Consequences of a write

    def _torque_enable_written(self) -> None:
        self._shut_down_if_masked()
        if self.torque_enabled and not self._torque:
            self._forget_turns_in_position_mode()
            self._hold_position()

    def _operating_mode_written(self) -> None:
        self._forget_turns_in_position_mode()
        self.present.derive(self.applied_share)  # the mode determines whether Homing Offset applies
        self._reset_goals()
        for name in (*GAINS, *PROFILE):
            if name in self.memory:
                self.memory.set(name, self.memory.registers[name].initial)

    def _forget_turns_in_position_mode(self) -> None:
        if self.operating_mode == POSITION_MODE and self.model.operating_modes:
            self.present.forget_turns(self._angle())

    def _reset_goals(self) -> None:
        for goal, limit in LIMIT_OF_GOAL.items():
            self.memory.set(goal, 0 if goal == "Goal Velocity" else self.memory.get(limit))
        self._hold_position()

    def _hold_position(self) -> None:
        ticks = self.present.ticks(self._angle())
        if self.model.operating_modes:
            self.memory.set("Goal Position", round(ticks))
        self.controller.start(ticks)

    def _derive(self) -> None:
        """Recompute the values that every packet needs; called after any change."""
        memory = self.memory
        self.id = memory.get("ID")
        shadow = memory.get("Secondary(Shadow) ID", _NO_SHADOW_ID)
        self.shadow_id = shadow if shadow < _NO_SHADOW_ID else None
        """Secondary ID: instructions to it are executed without a reply; None if the servo has none."""
        baud = memory.get("Baud Rate", BAUD_RATES.index(self._set_baud))
        self.baud = BAUD_RATES[baud] if baud < len(BAUD_RATES) else self._set_baud
        self.return_delay_s = 2e-6 * memory.get("Return Delay Time")
        self.status_return_level = memory.get("Status Return Level", 2)
        self.alert = ALERT if memory.get("Hardware Error Status") else 0
        watchdog = memory.get("Bus Watchdog")
        self._torque = self.torque_enabled
        counting = self._torque and watchdog != WATCHDOG_TRIPPED
        self.watchdog_s = watchdog * WATCHDOG_UNIT_S if counting else 0.0
        """Duration of silence after which the watchdog trips [s]; 0 while the watchdog is inactive."""

        self.present.derive(self.applied_share)
        self._mode = self.operating_mode if self.model.operating_modes else -1
        self._driven = self._torque and self._mode == CURRENT_MODE
        self._current_per_tick = self.present.sign * self.model.current_unit_a
        moves = self._torque and bool(self.model.operating_modes)
        most = min(memory.get("PWM Limit", FULL_PWM), abs(memory.get("Goal PWM", FULL_PWM)))
        self._is_limited = self._voltage_limited or (self._mode == CURRENT_MODE and most < FULL_PWM)
        """Whether the supply, PWM Limit or Goal PWM may limit the current in current mode."""

        is_controlled = moves and (self._mode != CURRENT_MODE or self._is_limited)
        self.needs_ticks = self.health.changes or is_controlled
        """Whether the servo's state changes with time alone, so that the bus must call `tick`."""

        if self._driven and self._is_limited:  # the next step of the servo's loop applies the goal
            stall = most / FULL_PWM * self.supply_v / self.model.resistance_ohm
            self.motor_current_a = max(-stall, min(stall, self.motor_current_a))
        elif self._driven:
            self.motor_current_a = self.goal_current_ticks * self._current_per_tick
        elif not moves:
            self.motor_current_a = 0.0
        self._current_limit: int = memory.get("Current Limit") if "Goal Current" in memory else -1
        by_goal = memory.get("Drive Mode") & _TORQUE_ON_BY_GOAL_UPDATE
        accepts = bool(self.model.operating_modes) and not by_goal and watchdog != WATCHDOG_TRIPPED
        takes_goal_pwm = accepts and self._mode != CURRENT_MODE and "Goal PWM" in memory
        self._goal_pwm_limit = memory.get("PWM Limit") if takes_goal_pwm else -1
        """Largest Goal PWM that the fast path accepts [ticks]; -1 if every write takes the general path."""
        # The fast path bypasses the controller, which limits the current by the supply or, in one mode, by the goal.
        by_controller = self._is_limited or self._mode == CURRENT_POSITION_MODE
        self._takes_goal_current = accepts and not by_controller and self._current_limit >= 0
        if not is_controlled:
            self._applied_share = None
        if self.needs_ticks:
            self.controller.goals = Goals.read(self._mode, memory)
        self.changed()

    def applied_share(self, current: float, velocity: float) -> float:
        """Return the bridge's duty cycle, signed, between -1 and 1: the one that the servo's loop applied last, or else
        the one for this current [A] at this velocity [rad/s].

        With backlash, the current flows at the rotor's velocity, which is not that of the output shaft.
        """
        return self.supply_share(current, velocity) if self._applied_share is None else self._applied_share

    def supply_share(self, current: float, velocity: float = 0.0) -> float:
        """Return the bridge's duty cycle for this current [A] at this velocity [rad/s], signed, between -1 and 1."""
        volt = self.model.resistance_ohm * current + self.model.back_emf_v_s * velocity
        return max(-1.0, min(1.0, volt / self.supply_v)) if self._torque and self.supply_v > 0.0 else 0.0
