"""The hand moves joints whose torque is off, holds them, and releases them when their torque comes on."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.hand import Move, parse_move
from hil.fakes.description import FakeArm, load_fake, make_bus
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.plant import CanBeHeld
from tests.fakes.conftest import Bench
from tests.support.paths import CONFIGS

LINK = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
DRIVE = {"mass": 0.08, "rotor_inertia": 8e-8, "gear_ratio": 353.5, "torque_constant": 1.8, "coulomb": 0.05}
SERVO = {"model": "XM430-W350", "zero_ticks": 2048}


def described(drive: dict[str, Any], joints: int = 2, **more: Any) -> FakeArm:
    start = [-math.pi / 2, 0.0][:joints]
    return FakeArm.model_validate(
        {
            "servos": [{"id": number + 1, **SERVO} for number in range(joints)],
            "arm": {"start": start, "links": [LINK] * joints, "drives": [drive] * joints},
            **more,
        }
    )


def on_bench(description: FakeArm) -> Bench:
    bench = Bench.__new__(Bench)
    bench.clock = VirtualClock()
    bench.bus = make_bus(description, bench.clock)
    return bench


@pytest.mark.parametrize("joints", [1, 2])
@pytest.mark.parametrize(
    "drive",
    [
        DRIVE,
        DRIVE | {"presliding_stiffness": 100.0},
        DRIVE | {"coulomb_width": 0.05, "viscous": 0.1},
        DRIVE | {"backlash": 0.01, "gear_damping": 5.0},
        DRIVE | {"rotor_inertia": 0.0},
    ],
    ids=["dry", "presliding", "smooth", "play", "no rotor"],
)
def test_a_limp_joint_is_moved_and_held(drive: dict[str, Any], joints: int) -> None:
    bench = on_bench(described(drive, joints))
    bench.bus.hand.move(*(Move(servo=number + 1, to=0.4 + number, duration=0.5) for number in range(joints)))
    bench.wait(0.25)
    assert all(servo.value("Torque Enable") == 0 for servo in bench.bus.servos.values())
    halfway = bench.read(1, 132, 4, signed=True)
    assert 1100 < halfway < 2200
    assert bench.read(1, 128, 4, signed=True) > 10
    bench.wait(3.0)
    for number in range(joints):
        wanted = 2048 + (0.4 + number) * 4096 / math.tau
        assert bench.read(number + 1, 132, 4, signed=True) == pytest.approx(wanted, abs=12)
        rocking = 30 if "backlash" in drive else 2  # a link rocks in the play of its gears
        assert abs(bench.read(number + 1, 128, 4, signed=True)) <= rocking


def test_a_move_can_end_at_ticks_and_be_released(make_bench: Callable[..., Any]) -> None:
    bench = on_bench(described(DRIVE | {"coulomb": 0.0}, 1))
    bench.bus.hand.move(Move(servo=1, ticks=2500, duration=0.3, hold=0.2))
    bench.wait(0.45)
    assert bench.read(1, 132, 4, signed=True) == pytest.approx(2500, abs=4)
    bench.wait(0.4)
    assert bench.read(1, 132, 4, signed=True) < 2300  # it falls
    assert not bench.bus.hand.busy


@pytest.mark.parametrize("end", [{"ticks": 1 << 20}, {"to": -12.5}])
def test_a_hand_that_is_told_to_be_quick_is_as_fast_as_it_can_be(end: dict[str, Any]) -> None:
    bench = on_bench(described(DRIVE, 1))
    bench.bus.hand.move(Move(servo=1, duration=1e-9, **end))
    bench.wait(10.0)
    expected = end.get("ticks", 2048 - 12.5 * 4096 / math.tau)
    assert bench.read(1, 132, 4, signed=True) == pytest.approx(expected, abs=4)


def test_ticks_are_those_of_present_position_whatever_shifts_it() -> None:
    description = described(DRIVE, 1)
    servo = description.servos[0].model_copy(
        update={"registers": {"Homing Offset": 700, "Drive Mode": 1}, "direction": -1}
    )
    bench = on_bench(description.model_copy(update={"servos": (servo,)}))
    bench.bus.hand.move(Move(servo=1, ticks=1500))
    bench.wait(1.5)
    assert bench.read(1, 132, 4, signed=True) == pytest.approx(1500, abs=4)


def test_the_hand_lets_go_when_torque_comes_on() -> None:
    bench = on_bench(described(DRIVE))
    bench.bus.hand.move(Move(servo=1, to=0.0, duration=0.3), Move(servo=2, to=0.0, at=0.6))
    bench.wait(0.5)
    assert bench.bus.hand.holds == {0}
    bench.exchange(b"")
    assert bench.write(1, 64, 1) == 0
    assert bench.write(2, 64, 1) == 0
    bench.wait(1.0)
    assert bench.bus.servos[1].torque_enabled
    assert not bench.bus.hand.busy
    assert bench.write(1, 116, 2300, 4) == 0
    bench.wait(1.0)
    assert bench.read(1, 132, 4, signed=True) > 2150  # free to follow its goal


def test_the_hand_refuses_to_move_a_joint_whose_torque_is_on() -> None:
    bench = on_bench(described(DRIVE))
    assert bench.write(2, 64, 1) == 0
    with pytest.raises(ValueError, match="the torque of servo 2 is on"):
        bench.bus.hand.move(Move(servo=1, to=0.0), Move(servo=2, to=0.0))
    assert not bench.bus.hand.busy, "neither of the two moves"
    bench.bus.hand.move(Move(servo=2, to=0.5, at=1.0))
    assert bench.write(2, 64, 0) == 0
    bench.wait(3.0)
    assert bench.read(2, 132, 4, signed=True) == pytest.approx(2048 + 326, abs=12)


def test_release_forgets_what_was_to_come() -> None:
    bench = on_bench(described(DRIVE))
    bench.bus.hand.move(Move(servo=1, to=0.0, at=0.5), Move(servo=2, to=1.0, at=0.5))
    bench.bus.hand.release(1)
    bench.wait(2.0)
    assert bench.read(1, 132, 4, signed=True) < 1500
    assert bench.read(2, 132, 4, signed=True) == pytest.approx(2048 + 652, abs=12)
    bench.bus.hand.release()
    assert not bench.bus.hand.busy


def test_moves_of_the_description_happen() -> None:
    bench = on_bench(described(DRIVE, 1, moves=[{"servo": 1, "to": 0.0, "at": 1.0, "duration": 0.5}]))
    before = bench.read(1, 132, 4, signed=True)
    bench.wait(0.9)
    assert bench.read(1, 132, 4, signed=True) == before
    bench.wait(1.0)
    assert bench.read(1, 132, 4, signed=True) == pytest.approx(2048, abs=4)


def test_what_cannot_be_is_refused(bench: Bench) -> None:
    with pytest.raises(PlantError, match=r"FreeInertia has no hold"):
        bench.bus.hand.move(Move(servo=1, to=0.0))
    with pytest.raises(ValueError, match="no servo has the ID 9"):
        bench.bus.hand.move(Move(servo=9, to=0.0))


@pytest.mark.parametrize(
    ("text", "move"),
    [
        ("2:to=0.5", Move(servo=2, to=0.5)),
        ("1:ticks=3000,at=2,duration=0.5,hold=1", Move(servo=1, ticks=3000, at=2.0, duration=0.5, hold=1.0)),
    ],
)
def test_moves_as_text(text: str, move: Move) -> None:
    assert parse_move(text) == move


@pytest.mark.parametrize("text", ["", "x:to=1", "1", "1:to=a", "1:to=1,ticks=2", "1:speed=1", "300:to=0", "1:to=inf"])
def test_moves_that_cannot_be_read(text: str) -> None:
    with pytest.raises(ValueError, match="move"):
        parse_move(text)


def test_the_joints_of_a_spatial_arm_are_moved_held_and_released() -> None:
    bench = on_bench(load_fake(CONFIGS / "fake_viperx_300.toml"))
    bus = bench.bus
    servo = next(number for number, each in bus.servos.items() if each.connected)
    before = bus.plant.position[0]
    bus.hand.move(Move(servo=servo, to=before + 0.4, duration=0.5))
    bench.wait(2.0)
    bus.advance(bench.clock.now())
    assert bus.plant.position[0] == pytest.approx(before + 0.4, abs=0.02)
    assert abs(bus.plant.velocity[0]) < 0.01
    assert bus.hand.holds
    bus.hand.release()
    bench.wait(0.1)
    assert not bus.hand.holds


def test_a_spatial_arm_falls_when_it_is_released() -> None:
    bus = on_bench(load_fake(CONFIGS / "fake_viperx_300.toml")).bus
    plant = bus.plant
    assert isinstance(plant, CanBeHeld)
    plant.advance(1.0, [0.0] * 6)
    shoulder = plant.position[1]
    plant.hold(1, 0.4)
    plant.advance(2.0, [0.0] * 6)
    lifted = plant.position[1]
    assert abs(lifted - shoulder) > 0.1  # the weight drags at the hand
    plant.hold(1, None)
    plant.advance(4.0, [0.0] * 6)
    assert plant.position[1] != pytest.approx(lifted, abs=0.05)
