"""A bench: two fake servos on a bus, each turning a free inertia, and a host that sends single packets."""

from collections.abc import Callable, Sequence

import pytest

from hil.drivers.packet import Framer, Instruction, Packet, encode
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo

XM430 = load_model("XM430-W350")


class FreeInertia:
    """One free inertia per joint, driven by its motor without lag; records the commands."""

    def __init__(self, joints: int, acceleration_per_ampere: float = 50.0) -> None:
        self.joints = joints
        self.gain = acceleration_per_ampere
        self.time = 0.0
        self.position = [0.0] * joints
        self.velocity = [0.0] * joints
        self.current = [0.0] * joints
        self.told: list[tuple[float, list[float]]] = []
        """Record of every advance: until when [s], with which currents [A]."""

    def advance(self, until: float, current: Sequence[float]) -> None:
        step = until - self.time
        if step <= 0:
            return
        self.told.append((until, list(current)))
        for joint, ampere in enumerate(current):
            acceleration = self.gain * ampere
            self.position[joint] += step * self.velocity[joint] + 0.5 * step**2 * acceleration
            self.velocity[joint] += step * acceleration
            self.current[joint] = ampere
        self.time = until


class Bench:
    """A host on a bus of fake servos with IDs 1, 2, ..."""

    def __init__(self, *servos: EmulatedServo, adapter_latency_us: float = 0.0) -> None:
        self.clock = VirtualClock()
        self.plant = FreeInertia(len(servos))
        self.bus = FakeBus(servos, self.plant, self.clock, adapter_latency_us=adapter_latency_us)

    def servo(self, servo_id: int = 1) -> EmulatedServo:
        return self.bus.servos[servo_id]

    def exchange(self, raw: bytes, timeout_s: float = 0.01) -> list[Packet]:
        """Send bytes; return every packet received within the timeout."""
        self.bus.write(raw)
        return list(Framer().feed(self.bus.read(10_000, timeout_s)))

    def ask(self, servo_id: int, instruction: int, body: bytes = b"") -> Packet:
        """Send one instruction and return the single status expected from this servo."""
        (status,) = self.exchange(encode(servo_id, instruction, body))
        assert status.is_status
        assert status.id == servo_id
        return status

    def write(self, servo_id: int, address: int, value: int, size: int = 1) -> int:
        """Write one register; return the ERR byte of the status."""
        data = value.to_bytes(size, "little", signed=value < 0)
        return self.ask(servo_id, Instruction.WRITE, address.to_bytes(2, "little") + data).error

    def read(self, servo_id: int, address: int, size: int, *, signed: bool = False) -> int:
        """Read one register, which must be readable."""
        body = address.to_bytes(2, "little") + size.to_bytes(2, "little")
        status = self.ask(servo_id, Instruction.READ, body)
        assert status.error == 0
        assert len(status.data) == size
        return int.from_bytes(status.data, "little", signed=signed)

    def arm(self, servo_id: int = 1, watchdog: int = 0, goal_ticks: int = 0) -> None:
        """Set current mode and the watchdog, switch torque on with a zero goal, then write the goal."""
        assert self.write(servo_id, 11, 0) == 0
        assert self.write(servo_id, 102, 0, 2) == 0
        assert self.write(servo_id, 98, watchdog) == 0
        assert self.write(servo_id, 64, 1) == 0
        assert self.write(servo_id, 102, goal_ticks, 2) == 0

    def wait(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now() + seconds)


@pytest.fixture
def make_bench() -> Callable[..., Bench]:
    """Return a function that builds a bench from servo settings, one dict each; by default two standard XM430-W350."""

    def make(*settings: dict[str, object], adapter_latency_us: float = 0.0) -> Bench:
        servos = [
            EmulatedServo(**({"model": XM430, "servo_id": number} | chosen))  # type: ignore[arg-type]
            for number, chosen in enumerate(settings or ({}, {}), start=1)
        ]
        return Bench(*servos, adapter_latency_us=adapter_latency_us)

    return make


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()
