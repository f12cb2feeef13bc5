"""A fake arm that keeps its state from one opening of its port to the next."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.experiment.run import run_experiment
from hil.fakes.servo.servo import EmulatedServo
from hil.runs.run_folder import RunFolder

Arm = Callable[..., Config]
FREE = {"Goal Position", "Realtime Tick"}
"""Registers that a servo changes by itself."""

SHORT = ("ramp = 1.0 ", "held_out = false\nsettle_within = 0.5\nramp = 0.2 ")


@dataclass
class Bench:
    """One fake arm that keeps its state whenever a port is opened; records EEPROM writes of every servo."""

    port: Any = None
    before: dict[int, dict[str, int]] = field(default_factory=dict)
    eeprom: dict[int, list[str]] = field(default_factory=dict)
    prepare: Callable[[Any], None] = lambda port: None

    @property
    def servos(self) -> dict[int, EmulatedServo]:
        return dict(self.port.bus.servos)

    def changed(self) -> list[str]:
        """Registers that differ from when the port was first opened."""
        return [
            f"{name} of {servo_id}: {value} -> {self.servos[servo_id].value(name)}"
            for servo_id, registers in self.before.items()
            for name, value in registers.items()
            if self.servos[servo_id].value(name) != value
        ]

    def take(self, port: Any) -> None:
        self.port = port
        self.prepare(port)
        for servo_id, servo in port.bus.servos.items():
            table = servo.model.registers.values()
            self.before[servo_id] = {
                each.name: servo.value(each.name) for each in table if each.writable and each.name not in FREE
            }
            self.eeprom[servo_id] = []
            self._count(servo, self.eeprom[servo_id])

    def _count(self, servo: EmulatedServo, written: list[str]) -> None:
        store = servo.memory.store

        def counting(register: Any, value: int) -> None:
            if register.eeprom:
                written.append(register.name)
            store(register, value)

        servo.memory.store = counting  # type: ignore[method-assign]


def play(config: Config, folder: Path) -> RunFolder:
    made = RunFolder.create(folder, config)
    run_experiment(config, made, config.path, lambda _: None)
    return made


def servos(bus: ServoBus) -> dict[int, Any]:
    """The emulated servos behind a bus, by ID."""
    fake: Any = bus.port
    found: dict[int, Any] = fake._serial.bus.servos
    return found
