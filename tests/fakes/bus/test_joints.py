"""Two servos on one joint."""

from typing import Any

import pytest

from hil.drivers.packet import Instruction, encode
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import DescriptionError, FakeArm, make_bus
from hil.fakes.servo.servo import EmulatedServo
from tests.fakes.conftest import XM430, Bench, FreeInertia

PAIR = ({"joint": 1}, {"joint": 1, "direction": -1}, {})


def pair(**second: Any) -> Bench:
    """Return servos 1 and 2 on one joint, the second one reversed, and servo 3 on the next joint."""
    bench = Bench.__new__(Bench)
    bench.clock = VirtualClock()
    bench.plant = FreeInertia(2)
    servos = [EmulatedServo(XM430, 1), EmulatedServo(XM430, 2, direction=-1, **second), EmulatedServo(XM430, 3)]
    bench.bus = FakeBus(servos, bench.plant, bench.clock, joints=(0, 0, 1))
    return bench


def test_torques_add_and_each_servo_measures_its_own_current() -> None:
    bench = pair()
    for servo_id, goal in ((1, 100), (2, -60), (3, 10)):
        bench.arm(servo_id, goal_ticks=goal)
    bench.wait(0.01)
    assert [bench.read(i, 126, 2, signed=True) for i in (1, 2, 3)] == [100, -60, 10]
    assert bench.plant.current == pytest.approx([160 * 2.69e-3, 10 * 2.69e-3])


def test_positions_mirror() -> None:
    bench = pair(zero_ticks=2048)
    bench.plant.position[0] = 0.5
    assert bench.read(1, 132, 4, signed=True) + bench.read(2, 132, 4, signed=True) == pytest.approx(2048, abs=1)


def test_servos_that_fight_each_other_carry_their_currents() -> None:
    bench = pair()
    bench.arm(1, goal_ticks=200)
    bench.arm(2, goal_ticks=200)
    before = bench.plant.velocity[0]
    bench.wait(0.1)
    assert [bench.read(i, 126, 2, signed=True) for i in (1, 2)] == [200, 200]
    assert bench.plant.velocity[0] == before


def test_group_reads_are_those_of_single_reads() -> None:
    bench = pair()
    for servo_id in (1, 2, 3):
        bench.arm(servo_id, goal_ticks=30 * servo_id)
    span = (126).to_bytes(2, "little") + (10).to_bytes(2, "little")
    (first, second, third) = bench.exchange(encode(254, Instruction.SYNC_READ, span + b"\x01\x02\x03"))
    assert [int.from_bytes(packet.data[:2], "little", signed=True) for packet in (first, second, third)] == [30, 60, 90]
    velocities = [int.from_bytes(packet.data[2:6], "little", signed=True) for packet in (first, second)]
    assert velocities[0] == -velocities[1] != 0
    span = (124).to_bytes(2, "little") + (4).to_bytes(2, "little")  # not the span of a control cycle
    answers = bench.exchange(encode(254, Instruction.SYNC_READ, span + b"\x01\x02\x03"))
    assert [int.from_bytes(packet.data[2:4], "little", signed=True) for packet in answers] == [30, 60, 90]


def test_a_shadow_left_in_position_mode_fights_its_leader() -> None:
    """This is what happens on a ViperX if a program sets Operating Mode only through the Secondary ID."""
    bench = pair(registers={"Secondary(Shadow) ID": 1})
    assert bench.write(1, 11, 0) == 0
    assert bench.write(1, 102, 0, 2) == 0
    assert bench.write(1, 64, 1) == 0
    bench.exchange(encode(1, Instruction.WRITE, b"\x66\0\x50\0"))
    bench.wait(0.5)
    assert bench.bus.servos[1].operating_mode == 0
    assert bench.bus.servos[2].operating_mode == 3
    assert bench.bus.servos[2].torque_enabled
    assert bench.bus.servos[2].motor_current_a < -0.1 or abs(bench.plant.position[0]) > 1e-3


def described(*joints: Any) -> dict[str, Any]:
    link = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
    drive = {"mass": 0.08, "rotor_inertia": 8e-8, "gear_ratio": 353.5, "torque_constant": 1.8}
    servos = [{"id": n, "model": "XM430-W350", "zero_ticks": 0, **more} for n, more in enumerate(joints, start=1)]
    return {"servos": servos, "arm": {"start": [0.0, 0.0], "links": [link] * 2, "drives": [drive] * 2}}


def test_a_pair_described_in_toml() -> None:
    bus = make_bus(FakeArm.model_validate(described(*PAIR)), VirtualClock())
    assert bus.plant.joints == 2
    assert len(bus.servos) == 3


@pytest.mark.parametrize("joints", [({"joint": 1}, {"joint": 3}), ({"joint": 2}, {"joint": 2}), ({"joint": 0}, {})])
def test_joints_without_a_servo_are_named(joints: Any) -> None:
    with pytest.raises(ValueError, match="joint"):
        FakeArm.model_validate(described(*joints))
    assert issubclass(DescriptionError, ValueError)
