"""A MuJoCo model as the plant, compared with the fake's own pendulum; the error message without MuJoCo."""

import importlib
import math
import sys
from typing import Any

import pytest

from hil.fakes.plants.arm import Arm
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.pendulum import Pendulum
from hil.fakes.plants.plant import CanJam, load_plant

FACTORY = "hil.fakes.plants.mujoco_plant:make_plant"
MODEL = """
<mujoco>
  <option timestep="0.0005" gravity="0 0 -9.81" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="shoulder" type="hinge" axis="0 -1 0" damping="0.02" armature="0.01"/>
      <inertial pos="0.08 0 0" mass="0.2" diaginertia="5e-4 5e-4 5e-4"/>
    </body>
  </worldbody>
</mujoco>
"""
OPTIONS: dict[str, Any] = {"model": MODEL, "joints": ["shoulder"], "torque_constant": [1.8]}


def test_without_mujoco_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "hil.fakes.plants.mujoco_plant", raising=False)
    with pytest.raises(PlantError, match=r"pip install hil\[mujoco\]"):
        load_plant(FACTORY, {})


@pytest.fixture
def mujoco() -> None:
    pytest.importorskip("mujoco", reason='needs the extra "mujoco": pip install hil[mujoco]')
    importlib.import_module("hil.fakes.plants.mujoco_plant")


@pytest.mark.usefixtures("mujoco")
def test_it_swings_as_the_pendulum_does() -> None:
    link = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
    drive = {"mass": 0.0, "rotor_inertia": 0.01 / 100, "gear_ratio": 10.0, "torque_constant": 1.8, "viscous": 0.02}
    own = Pendulum(Arm.model_validate({"start": [0.0], "links": [link], "drives": [drive]}))
    theirs = load_plant(FACTORY, OPTIONS)
    for tick in range(1, 801):
        current = [0.1 * math.sin(0.02 * tick)]
        own.advance(tick / 400, current)
        theirs.advance(tick / 400, current)
        assert theirs.position[0] == pytest.approx(own.position[0], abs=0.01)
    assert abs(own.position[0]) > 0.1


@pytest.mark.usefixtures("mujoco")
def test_it_can_be_jammed() -> None:
    plant = load_plant(FACTORY, OPTIONS)
    assert isinstance(plant, CanJam)
    plant.advance(0.1, [0.0])
    plant.jam(0, True)
    held = plant.position[0]
    plant.advance(0.2, [0.0])
    assert plant.position[0] == held


@pytest.mark.usefixtures("mujoco")
@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"model": "nowhere.xml"}, "nowhere.xml"),
        ({"model": "<mujoco><nonsense/></mujoco>"}, "text:"),
        ({"joints": ["elbow"]}, 'no hinge "elbow"; it has shoulder'),
        ({"torque_constant": [1.0, 2.0]}, "2 entries for 1 joints"),
        ({"colour": 3}, "unexpected keyword argument 'colour'"),
    ],
)
def test_wrong_options(options: dict[str, Any], said: str) -> None:
    with pytest.raises(PlantError) as caught:
        load_plant(FACTORY, OPTIONS | options)
    assert said in str(caught.value)
