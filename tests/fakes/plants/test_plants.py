"""Backlash, cogging, stops, tilt, jams; third-party plants."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import serial
from pydantic import ValidationError

from hil import fakes
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import DescriptionError, FakeArm, load_fake, make_bus
from hil.fakes.plants.arm import Arm, base_parameters
from hil.fakes.plants.backlash import GearedArm
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.pendulum import Pendulum
from hil.fakes.plants.plant import load_plant, make_plant
from hil.fakes.plants.two_link import TwoLink
from hil.fakes.protocol_fake import FakeSerial

LINK = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
DRIVE = {"mass": 0.08, "rotor_inertia": 8e-8, "gear_ratio": 353.5, "torque_constant": 1.8}
KINDS = ["pendulum", "two links", "pendulum with play", "two links with play"]


def arm(kind: str = "pendulum", **changes: Any) -> Arm:
    count = 1 if "pendulum" in kind else 2
    of_arm = {key: changes.pop(key) for key in ("gravity", "tilt", "start") if key in changes}
    if "play" in kind:
        changes = {"backlash": 0.005, **changes}
    start = of_arm.pop("start", [-math.pi / 2, 0.0][:count])
    return Arm.model_validate(
        {"start": start, "links": [LINK] * count, "drives": [{**DRIVE, **changes}] * count, **of_arm}
    )


def played(plant: Any, seconds: float, current: Callable[[float], Sequence[float]]) -> list[tuple[float, ...]]:
    positions = []
    for tick in range(1, round(seconds * 400) + 1):
        plant.advance(tick / 400, current(tick / 400))
        positions.append(tuple(plant.position))
    return positions


@pytest.mark.parametrize(
    ("kind", "of"), list(zip(KINDS, [Pendulum, TwoLink, GearedArm, GearedArm], strict=True)), ids=KINDS
)
def test_the_plant_that_an_arm_needs(kind: str, of: type) -> None:
    assert isinstance(make_plant(arm(kind)), of)


@pytest.mark.parametrize("count", [1, 2])
def test_without_play_the_geared_arm_is_the_other_one(count: int) -> None:
    described = arm(KINDS[count - 1], viscous=0.04, coulomb=0.03, stribeck_rise=0.3, current_lag=1e-3)

    def current(t: float) -> list[float]:
        return [0.15 * math.sin(5 * t), 0.1 * math.sin(7 * t)][:count]

    expected = played(make_plant(described), 2.0, current)
    actual = played(GearedArm(described), 2.0, current)
    for ours, theirs in zip(actual, expected, strict=True):
        assert ours == pytest.approx(theirs, abs=0.02)


def test_inside_the_play_the_link_swings_and_the_rotor_stays() -> None:
    plant = GearedArm(arm("pendulum with play", backlash=0.05, coulomb=0.2, start=[-math.pi / 2 + 0.02]))
    swung = played(plant, 2.0, lambda t: [0.0])
    assert min(position for (position,) in swung) < -math.pi / 2 - 0.004
    assert plant.rotor_angle[0] == pytest.approx(-math.pi / 2 + 0.02, abs=1e-3)
    assert abs(plant.position[0] - plant.rotor_angle[0]) <= 0.03


def test_play_shows_as_hysteresis() -> None:
    plant = GearedArm(arm("pendulum with play", backlash=0.04, coulomb=0.02, gravity=0.0, viscous=0.2))
    played(plant, 1.0, lambda t: [0.05])
    ahead = plant.rotor_angle[0] - plant.position[0]
    for tick in range(400, 800):
        plant.advance((tick + 1) / 400, [-0.05])
    behind = plant.rotor_angle[0] - plant.position[0]
    assert ahead - behind > 0.02
    assert ahead == pytest.approx(0.02, abs=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_stops_hold_and_bounce(kind: str) -> None:
    count = 1 if "pendulum" in kind else 2
    plant = make_plant(arm(kind, stops=[-1.9, 0.6], viscous=0.05))
    positions = played(plant, 3.0, lambda t: [0.5] * count)
    for position in positions:
        assert all(-2.0 < angle < 0.75 for angle in position)
    assert max(position[0] for position in positions) > (0.6 if count == 1 else -1.6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_jammed_joint_stands_still_and_goes_on_afterwards(kind: str) -> None:
    count = 1 if "pendulum" in kind else 2
    plant = make_plant(arm(kind, backlash=0.0) if "play" not in kind else arm(kind))
    push = [0.3, 0.1][:count]
    plant.advance(0.1, push)
    plant.jam(0, True)  # type: ignore[attr-defined]
    plant.advance(0.11, push)
    held = plant.position[0]
    plant.advance(0.5, push)
    assert plant.position[0] == pytest.approx(held, abs=0.01)
    plant.jam(0, False)  # type: ignore[attr-defined]
    plant.advance(0.7, push)
    assert abs(plant.position[0] - held) > 0.05


def test_cogging_pulls_to_its_detents() -> None:
    plant = Pendulum(arm(cogging=0.05, cogging_cycles=12.0, gravity=0.0, viscous=0.05, start=[0.1]))
    played(plant, 8.0, lambda t: [0.0])
    assert math.sin(12 * plant.position[0]) == pytest.approx(0.0, abs=0.05)
    assert math.cos(12 * plant.position[0]) < 0  # the stable ones


def test_fast_cogging_averages_out() -> None:
    plain, cogged = (Pendulum(arm(cogging=level, cogging_cycles=2000.0, gravity=0.0), [5.0]) for level in (0.0, 0.05))
    for plant in (plain, cogged):
        plant.advance(1.0, [0.0])
    assert cogged.position[0] == pytest.approx(plain.position[0], abs=0.02)


def test_tilt_is_less_gravity() -> None:
    flat = arm("two links", tilt=math.pi / 2)
    assert base_parameters(flat)["gravity_1"] == pytest.approx(0.0, abs=1e-12)
    assert base_parameters(arm(tilt=math.pi / 3))["gravity_1"] == pytest.approx(
        base_parameters(arm())["gravity_1"] / 2, rel=1e-9
    )
    plant = make_plant(arm("two links", tilt=math.pi / 2, start=[0.3, 0.2]))
    plant.advance(1.0, [0.0, 0.0])
    assert tuple(plant.position) == pytest.approx((0.3, 0.2), abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"stops": [1.0, 0.5]}, "the first must be less than the second"),
        ({"stops": [0.0, 0.5]}, "beyond its hard stops"),
        ({"backlash": 0.01, "rotor_inertia": 0.0}, "backlash needs a rotor_inertia"),
    ],
)
def test_impossible_drives(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        arm("pendulum", **changes)


# Third-party plants


class Good:
    def __init__(self, speed: float = 1.0) -> None:
        self.joints = 1
        self.position: Any = [0.0]
        self.velocity: Any = [speed]
        self.current: Any = [0.0]

    def advance(self, until: float, current: Sequence[float]) -> None:
        self.position = [self.velocity[0] * until]


class Nan(Good):
    def advance(self, until: float, current: Sequence[float]) -> None:
        if until > 1.0:
            self.velocity = [math.nan]


class TwoNumbers(Good):
    def advance(self, until: float, current: Sequence[float]) -> None:
        self.position = [0.0, 0.0]


class Lame:
    joints = 1


def fails() -> None:
    raise RuntimeError("no such robot")


@pytest.fixture(autouse=True)
def plants(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = ModuleType("plants_of_others")
    for name in ("Good", "Nan", "TwoNumbers", "Lame", "fails"):
        setattr(module, name, globals()[name])
    monkeypatch.setitem(sys.modules, "plants_of_others", module)
    fakes.allow_code()
    yield
    fakes.allow_code(False)


def described(plant: str, **options: Any) -> FakeArm:
    servo = {"id": 1, "model": "XM430-W350", "zero_ticks": 0}
    return FakeArm.model_validate({"servos": [servo], "plant": plant, "plant_options": options})


@pytest.mark.parametrize(
    "name",
    ["plants_of_others:Good", "os:system", "hil.fakes.plants.plant:load_plant", "hil.fakes.plants.mujoco_plant:Path"],
)
def test_a_file_runs_no_code_of_its_own_without_leave(name: str) -> None:
    fakes.allow_code(False)
    with pytest.raises(PlantError, match="--allow-code"):
        load_plant(name, {"command": "false"})


def test_another_plant() -> None:
    bus = make_bus(described("plants_of_others:Good", speed=2.0), VirtualClock())
    bus.advance(1.5)
    assert bus.plant.position == [3.0]
    assert base_parameters(described("plants_of_others:Good").arm) == {}


def test_the_module_of_a_plant_may_be_beside_the_toml_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    servo = '[[fake.servos]]\nid = 1\nmodel = "XM430-W350"\nzero_ticks = 0\n'
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        text = f'[fake]\nplant = "plant_of_this_test:Good"\nplant_options = {{ speed = 2.0 }}\n{servo}'
        (tmp_path / name / "arm.toml").write_text(text, encoding="utf-8")
    first, second = (tmp_path / name / "arm.toml" for name in ("first", "second"))
    with pytest.raises(PlantError, match=f"No module named 'plant_of_this_test'; .*, or one in {first.parent}$"):
        make_bus(load_fake(first), VirtualClock())
    for file in (first, second):
        (file.parent / "plant_of_this_test.py").write_text("from plants_of_others import Good\n", encoding="utf-8")
    bus = make_bus(load_fake(first).model_copy(update={"seed": 3}), VirtualClock())
    bus.advance(1.5)
    assert bus.plant.position == [3.0]
    with pytest.raises(
        PlantError, match=f"already loaded {first.parent}/.* not .* in {second.parent}; rename one of them$"
    ):
        make_bus(load_fake(second), VirtualClock())
    monkeypatch.delitem(sys.modules, "plant_of_this_test")
    fakes.allow_code(False)
    with pytest.raises(PlantError, match="--allow-code"):
        make_bus(load_fake(first), VirtualClock())


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_such_module:Good", "No module named 'no_such_module'; give \"module:factory\""),
        ("plants_of_others:Bad", "has no attribute 'Bad'"),
        ("plants_of_others", 'give "module:factory"'),
        ("plants_of_others:Lame", "its Lame lacks position, velocity, current, advance"),
        ("plants_of_others:fails", "RuntimeError: no such robot"),
    ],
)
def test_plants_that_cannot_be_made(name: str, said: str) -> None:
    with pytest.raises(PlantError) as caught:
        load_plant(name, {})
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Nan", r"at 2 s: velocity is \[nan\], which is not finite"),
        ("TwoNumbers", r"at 2 s: position is \[0.0, 0.0\]; it must be one number for each of the plant's joints \(1\)"),
    ],
)
def test_plants_that_give_no_state(name: str, said: str) -> None:
    bus = make_bus(described(f"plants_of_others:{name}"), VirtualClock())
    with pytest.raises(PlantError, match=said):
        bus.advance(2.0)


def test_joints_of_plant_and_servos_must_agree() -> None:
    servos = [{"id": number, "model": "XM430-W350", "zero_ticks": 0} for number in (1, 2)]
    fake = FakeArm.model_validate({"servos": servos, "plant": "plants_of_others:Good"})
    with pytest.raises(PlantError, match="has 1 joints for 2 servos"):
        make_bus(fake, VirtualClock())


def test_arm_or_plant(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text('[fake]\n[[fake.servos]]\nid = 1\nmodel = "XM430-W350"\nzero_ticks = 0\n', encoding="utf-8")
    with pytest.raises(DescriptionError, match="give exactly one of these: the table arm, the table chain, or plant"):
        load_fake(path)


def test_a_plant_that_cannot_be_made_is_a_port_that_cannot_be_opened() -> None:
    port = FakeSerial(None, description=described("plants_of_others:fails"))
    with pytest.raises(serial.SerialException, match="no such robot"):
        port.open()
