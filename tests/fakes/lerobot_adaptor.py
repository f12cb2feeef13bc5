"""LeRobot's mock of Dynamixel motors, replaced by the fake bus, for LeRobot's own `tests/motors/test_dynamixel.py`.

That file creates "stubs": a packet and the expected reply. Here a stub sets the fake servos so that they give that
reply, and counts the packets. Where no real servo would give the expected reply, the fake behaves like a real servo,
and the test fails.
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from threading import Thread
from typing import Any

from hil.drivers.packet import Packet
from hil.fakes.bus.faults import Fault
from hil.fakes.description import FakeArm
from hil.fakes.pty_server import PtyServer
from hil.fakes.servo.servo import EmulatedServo

MODELS = {1: "XL430-W250", 2: "XM540-W270", 3: "XL330-M077"}
"""The servos of LeRobot's tests, by ID."""

_ONE = {
    "gravity": 0.0,
    "start": [0.0],
    "links": [{"length": 0.1, "mass": 0.05, "centre": 0.05, "inertia": 1e-4}],
    "drives": [{"mass": 0.05, "rotor_inertia": 8e-8, "gear_ratio": 300.0, "torque_constant": 1.0}],
}
_PRESENT_POSITION = 132


class Stub:
    """One expected packet: whether it arrived, and how often."""

    def __init__(self, motors: "MockMotors", matches: Callable[[Packet], bool]) -> None:
        self._motors = motors
        self._matches = matches

    @property
    def calls(self) -> int:
        return sum(self._matches(packet) for packet in list(self._motors.heard))

    @property
    def called(self) -> bool:
        return self.calls > 0

    def wait_called(self, timeout: float = 2.0) -> bool:
        deadline = time.monotonic() + timeout
        while not self.called and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.called


class MockMotors:
    """Three servos on a terminal."""

    def __init__(self) -> None:
        servos = [{"id": servo_id, "model": name, "zero_ticks": 2048} for servo_id, name in MODELS.items()]
        self._server = PtyServer(
            FakeArm.model_validate(
                {
                    "servos": servos,
                    "plant": "hil.fakes.plants.independent:make_plant",
                    "plant_options": {"joints": [_ONE] * len(servos)},
                }
            )
        )
        self._bus = self._server.bus
        self._thread = Thread(target=self._server.serve, daemon=True)
        self.heard: list[Packet] = []
        self.stubs: dict[str, Stub] = {}
        self._names = itertools.count()
        receive = self._bus._instructions.receive

        def receive_and_keep(packet: Packet, now: float) -> None:
            self.heard.append(packet)
            receive(packet, now)

        self._bus._instructions.receive = receive_and_keep  # type: ignore[method-assign]

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._server.stop()
        self._thread.join()
        self._server.close()

    @property
    def port(self) -> str:
        return self._server.path

    # What LeRobot's tests build

    def build_ping_stub(self, dxl_id: int, model_nb: int, num_invalid_try: int = 0, error: int = 0) -> str:
        return self._stub(lambda packet: packet.instruction == 1 and packet.id == dxl_id)

    def build_broadcast_ping_stub(self, ids_models: Mapping[int, int] | None = None, num_invalid_try: int = 0) -> str:
        return self._stub(lambda packet: packet.instruction == 1 and packet.id == 254)

    def build_read_stub(
        self,
        address: int,
        length: int,
        dxl_id: int,
        value: int,
        reply: bool = True,
        error: int = 0,
        num_invalid_try: int = 0,
    ) -> str:
        self._hold(dxl_id, address, length, value)
        self._spoil(dxl_id, reply, error)
        return self._stub(lambda packet: packet.instruction == 2 and packet.id == dxl_id)

    def build_write_stub(
        self,
        address: int,
        length: int,
        dxl_id: int,
        value: int,
        reply: bool = True,
        error: int = 0,
        num_invalid_try: int = 0,
    ) -> str:
        self._spoil(dxl_id, reply, error)
        body = address.to_bytes(2, "little") + (value % (1 << 8 * length)).to_bytes(length, "little")
        return self._stub(lambda packet: packet.instruction == 3 and (packet.id, packet.body) == (dxl_id, body))

    def build_sync_read_stub(
        self, address: int, length: int, ids_values: Mapping[int, int], reply: bool = True, num_invalid_try: int = 0
    ) -> str:
        for servo_id, value in ids_values.items():
            self._hold(servo_id, address, length, value)
            self._spoil(servo_id, reply, 0)
        return self._stub(self._is_sync_read(address))

    def build_sequential_sync_read_stub(
        self, address: int, length: int, ids_values: Mapping[int, Sequence[int]]
    ) -> str:
        """Return the next value on each read, by moving the servos' joints beforehand."""
        turn = itertools.count()
        receive, asked = self._bus._instructions.receive, self._is_sync_read(address)

        def move_and_receive(packet: Packet, now: float) -> None:
            if asked(packet):
                index = next(turn)
                for servo_id, values in ids_values.items():
                    self._hold(servo_id, address, length, values[min(index, len(values) - 1)])
            receive(packet, now)

        self._bus._instructions.receive = move_and_receive  # type: ignore[method-assign]
        return self._stub(asked)

    def build_sync_write_stub(
        self, address: int, length: int, ids_values: Mapping[int, int], num_invalid_try: int = 0
    ) -> str:
        body = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        for servo_id, value in ids_values.items():
            body += bytes((servo_id,)) + value.to_bytes(length, "little")
        return self._stub(lambda packet: packet.instruction == 0x83 and packet.body == body)

    # Setting up a servo to give that answer

    def _stub(self, matches: Callable[[Packet], bool]) -> str:
        name = f"stub_{next(self._names)}"
        self.stubs[name] = Stub(self, matches)
        return name

    @staticmethod
    def _is_sync_read(address: int) -> Callable[[Packet], bool]:
        start = address.to_bytes(2, "little")
        return lambda packet: packet.instruction == 0x82 and packet.body.startswith(start)

    def _spoil(self, servo_id: int, reply: bool, error: int) -> None:
        if not reply:
            self._bus.faults.add(Fault(kind="lost_reply", servo=servo_id))
        if error:
            self._bus.faults.add(Fault(kind="status_error", servo=servo_id, amount=float(error)))

    def _hold(self, servo_id: int, address: int, length: int, value: int) -> None:
        """Set a servo's registers to a value; for Present Position, move the joint."""
        servo = next(each for each in self._bus._servos if each.id == servo_id)
        if address == _PRESENT_POSITION:
            self._stand(servo, value)
        else:
            servo.memory._readable.add((address, length))  # where it has no register too
            servo.memory.data[address : address + length] = (value % (1 << 8 * length)).to_bytes(length, "little")
            servo._derive()

    def _stand(self, servo: EmulatedServo, ticks: int) -> None:
        joint = list(self._bus._servos).index(servo)
        plant: Any = self._bus.plant
        plant = getattr(plant, "_plant", plant)
        plant._joints[joint]._q = servo.present.angle(ticks)
