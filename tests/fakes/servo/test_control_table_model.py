"""The servo's control table compared with a minimal reference: a dictionary and the manual's rules.

hypothesis generates sequences of reads, writes, registered writes, torque, reboots and resets, and searches for one
after which the two differ.
"""

from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from hil.drivers.packet import Framer, Instruction, Packet, StatusError, encode
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import Register, load_model
from hil.fakes.servo.servo import BOOT_S, EmulatedServo
from tests.fakes.conftest import FreeInertia

GOALS = {"Goal PWM": "PWM Limit", "Goal Current": "Current Limit", "Goal Velocity": "Velocity Limit"}
# Left out: registers that time, joint or bus change; ID and Baud Rate, after which the servo would not respond.
LEFT_OUT = ("Present", "Realtime", "Moving Status", "Moving", "ID", "Baud Rate", "Velocity Traj", "Position Traj")
LEFT_OUT += (
    "Indirect",
    "Secondary",
    "Homing",
    "Status Return",
    "Drive Mode",
    "Startup",
    "Goal Position",
    "Bus Watchdog",
)
MODELS = ["XM430-W350", "XL330-M288", "XL430-W250", "XM540-W270"]
FIXED = {"Model Number", "Model Information", "Firmware Version"}


class Reference:
    """Registers as a dictionary."""

    def __init__(self, name: str) -> None:
        self.model = load_model(name)
        self.values = {register.name: register.initial for register in self.model.registers.values()}
        self.values.update({"Model Number": self.model.number, "Firmware Version": 48})
        self.values["Return Delay Time"] = 0
        self.registered: tuple[Register, int] | None = None
        self.boot()

    def boot(self) -> None:
        for register in self.model.registers.values():
            if not register.eeprom:
                self.values[register.name] = register.initial
        self.registered = None
        self.goals()

    def goals(self) -> None:
        for goal, limit in GOALS.items():
            if goal in self.values:
                self.values[goal] = 0 if goal == "Goal Velocity" else self.values[limit]

    def refusal(self, register: Register, value: int) -> int:
        if not register.writable or (register.eeprom and self.values["Torque Enable"]):
            return StatusError.ACCESS
        if register.name == "Operating Mode":
            return 0 if value in self.model.operating_modes else StatusError.DATA_RANGE
        if not register.minimum <= value <= register.maximum:
            return StatusError.DATA_RANGE
        if register.name in GOALS and abs(value) > self.values[GOALS[register.name]]:
            return StatusError.DATA_LIMIT
        return 0

    def write(self, register: Register, value: int) -> int:
        error = self.refusal(register, value)
        if not error:
            self.values[register.name] = value
            if register.name == "Operating Mode":
                self.goals()
                for name in self.values:
                    if name.endswith("Gain"):
                        self.values[name] = self.model.registers[name].initial
            self.find_errors(register.name)
        return error

    def find_errors(self, written: str) -> None:
        values = self.values
        if written in ("Max Voltage Limit", "Min Voltage Limit", "Temperature Limit"):
            supply = round(10 * self.model.nominal_voltage_v)
            if not values["Min Voltage Limit"] <= supply <= values["Max Voltage Limit"]:
                values["Hardware Error Status"] |= 1
            if values["Temperature Limit"] < 35:
                values["Hardware Error Status"] |= 4
        if values["Hardware Error Status"] & values["Shutdown"]:
            values["Torque Enable"] = 0


class ControlTable(RuleBasedStateMachine):
    @initialize(name=st.sampled_from(MODELS))
    def switch_on(self, name: str) -> None:
        self.reference = Reference(name)
        self.clock = VirtualClock()
        self.servo = EmulatedServo(self.reference.model, 1)
        self.bus = FakeBus([self.servo], FreeInertia(1, 0.0), self.clock)
        self.known = [r for r in self.reference.model.registers.values() if not r.name.startswith(LEFT_OUT)]

    def ask(self, instruction: int, body: bytes = b"") -> Packet:
        self.bus.write(encode(1, instruction, body))
        (status,) = Framer().feed(self.bus.read(1000, 0.005))
        return status

    def pick(self, data: Any) -> tuple[Register, int, bytes]:
        register = data.draw(st.sampled_from(self.known))
        bits = 8 * register.size
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if register.signed else (0, (1 << bits) - 1)
        near = st.sampled_from([register.minimum, register.maximum, register.initial])
        likely = near.flatmap(lambda v: st.integers(max(low, v - 1), min(high, v + 1)))
        value = data.draw(likely | st.integers(register.minimum, register.maximum) | st.integers(low, high))
        raw = value.to_bytes(register.size, "little", signed=register.signed)
        return register, value, register.address.to_bytes(2, "little") + raw

    @rule(data=st.data())
    def write(self, data: Any) -> None:
        register, value, body = self.pick(data)
        assert self.ask(Instruction.WRITE, body).error & 0x7F == self.reference.write(register, value), register.name

    @rule(on=st.booleans())
    def torque(self, on: bool) -> None:
        register = self.reference.model.registers["Torque Enable"]
        assert self.ask(Instruction.WRITE, b"\x40\0" + bytes((on,))).error & 0x7F == 0
        self.reference.write(register, int(on))

    @rule(data=st.data())
    def register_a_write(self, data: Any) -> None:
        register, value, body = self.pick(data)
        error = self.reference.refusal(register, value)
        assert self.ask(Instruction.REG_WRITE, body).error & 0x7F == error
        if not error:
            self.reference.registered = (register, value)
            self.reference.values["Registered Instruction"] = 1

    @rule()
    def act(self) -> None:
        error = self.ask(Instruction.ACTION).error & 0x7F
        registered, self.reference.registered = self.reference.registered, None
        if registered is None:
            assert error == StatusError.INSTRUCTION
        else:
            self.reference.values["Registered Instruction"] = 0
            assert error == self.reference.write(*registered)

    @rule()
    def reboot(self) -> None:
        self.ask(Instruction.REBOOT)
        self.reference.boot()
        self.reference.find_errors("Temperature Limit")
        self.clock.wait_until(self.clock.now() + BOOT_S)

    @rule()
    def factory_reset(self) -> None:
        self.ask(Instruction.FACTORY_RESET, b"\x02")
        for name, register in self.reference.model.registers.items():
            if name not in FIXED | {"ID", "Baud Rate"}:
                self.reference.values[name] = register.initial
        self.reference.boot()
        self.clock.wait_until(self.clock.now() + BOOT_S)

    @rule(data=st.data())
    def read(self, data: Any) -> None:
        register = data.draw(st.sampled_from(self.known))
        body = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        status = self.ask(Instruction.READ, body)
        value = int.from_bytes(status.data, "little", signed=register.signed)
        assert value == self.reference.values[register.name], register.name

    @invariant()
    def all_registers_agree(self) -> None:
        if hasattr(self, "known"):
            differ = {
                register.name: (self.servo.value(register.name), self.reference.values[register.name])
                for register in self.known
                if self.servo.value(register.name) != self.reference.values[register.name]
            }
            assert not differ


ControlTable.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None, derandomize=True)
TestControlTable = ControlTable.TestCase
