"""Links of an exported spatial arm are only computed from groups of parameters that this version also forms."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.description.urdf import read_urdf
from hil.drivers.servo_model import servo_model
from hil.drivers.servo_prior import servo_prior
from hil.errors import ExportError
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.export import chain_files
from hil.export.chain_links import ChainLinks, _rotor, _same_groups, chain_links
from hil.export.left_out import base_orientation
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def base() -> BaseParameters:
    return known_chain(load_config(CONFIGS / "leg.toml")).base


def groups_of(base: BaseParameters) -> dict[str, str]:
    return dict(zip(base.names, base.groups, strict=True))


GRIPPER = (
    '<joint name="tool" type="fixed"><parent link="{tip}"/><child link="palm"/><origin xyz="0 0 0.02"/></joint>'
    '<link name="palm"><inertial><mass value="0.03"/>{small}</inertial></link>'
    '<joint name="grip" type="prismatic"><parent link="palm"/><child link="finger"/><origin xyz="0 0.01 0"/>'
    '<axis xyz="0 1 0"/><limit lower="0" upper="0.02" velocity="1" effort="1"/></joint>'
    '<link name="finger"><inertial><mass value="{mass}"/>{small}</inertial></link>'
    '<joint name="pad_joint" type="fixed"><parent link="finger"/><child link="pad"/><origin xyz="0 0 0.01"/></joint>'
    '<link name="pad"><inertial><mass value="0.004"/>{small}</inertial></link></robot>'
)


@pytest.mark.parametrize(("mass", "whole"), [(0.01, True), (5.0, False)])
def test_a_gripper_keeps_its_inertia_and_the_arm_its_dynamics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mass: float, whole: bool
) -> None:
    """Its joints still move in the exported URDF, so their links need inertia; all together are what was identified."""
    config = load_config(CONFIGS / "leg.toml")
    text = (CONFIGS / "leg.urdf").read_text(encoding="utf-8")
    tip = read_urdf(CONFIGS / "leg.urdf").joints[-1].link
    small = '<inertia ixx="2e-6" iyy="2e-6" izz="2e-6" ixy="0" ixz="0" iyz="0"/>'
    gripper = GRIPPER.format(tip=tip, mass=mass, small=small)
    shape = '<collision><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision>'
    base = read_urdf(CONFIGS / "leg.urdf").base
    stands = f'<link name="pedestal">{shape}</link><joint name="on" type="fixed"><parent link="{base}"/>'
    gripper = f'{stands}<child link="pedestal"/></joint>{gripper}'
    text = text.replace("</robot>", gripper)
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    arm = read_urdf(tmp_path / "arm.urdf", [joint.name for joint in config.joints])
    identified = arm if whole else read_urdf(CONFIGS / "leg.urdf")  # too light for a gripper of 5 kg
    bodies = tuple(joint.body for joint in identified.joints)
    links = ChainLinks(tmp_path / "arm.urdf", arm, bodies, (0.01,) * 3, ())
    monkeypatch.setattr(chain_files, "chain_links", lambda *_: links)
    monkeypatch.setattr(chain_files, "add_actuators", lambda *_: None)
    terms = ("viscous", "coulomb", "offset", "coulomb_width")
    values = {f"{name}_{joint}": 0.02 for name in terms for joint in (1, 2, 3)} | {"moment_x_1": 0.1, "lag": 0.001}
    joints = [
        SimpleNamespace(name=j.name, goal_unit="A", position_limit=j.position_limit, has_limits=True)
        for j in config.joints
    ]
    model: Any = SimpleNamespace(
        values=values, stds=values, groups={"moment_x_1": ""}, joints=joints, base_gravity=np.ones(3)
    )
    model.torque_per_goal = lambda number: 1.5
    left = chain_files.export_chain_urdf(cast("Any", None), model, tmp_path / "out.urdf")
    assert [each.split(" = ")[0] for each in left][-10:] == [
        *(f"{name}_{joint}" for name in ("offset", "coulomb_width") for joint in (1, 2, 3)),
        "lag",
        *(f"torque per goal of {joint.name}" for joint in config.joints),
    ]
    assert "offset_1 = 0.02 N m (constant torque)" in left
    assert "in its frame, gravity is (1, 1, 1) m/s^2" in left[0] and left[0] in (tmp_path / "out.urdf").read_text()
    upright: Any = SimpleNamespace(base_gravity=np.array([0.0, 0.0, -9.81]))
    assert base_orientation(upright) == []
    again = read_urdf(tmp_path / "out.urdf", [joint.name for joint in config.joints])
    for one, other in zip(again.joints, bodies, strict=True):
        np.testing.assert_allclose(one.body.parameters, other.parameters, rtol=1e-9, atol=1e-12)
    assert {"finger", "pad"} == set(again.joints[-1].movable)
    for name, each in again.joints[-1].movable.items():
        assert each.mass > 0.0 and np.trace(each.inertia) > 0.0
        assert (each.mass == pytest.approx(mass if name == "finger" else 0.004)) is whole
    left = chain_files.export_chain_mjcf(cast("Any", None), model, tmp_path / "out.xml")
    assert any("the joint grip, which was held" in each and tip in each for each in left)
    assert "coulomb_width_2 = 0.02 rad/s (velocity width of the Coulomb friction step)" in left
    assert not any(each.startswith(("offset", "lag", "torque per goal")) for each in left)
    stands_on = ET.parse(tmp_path / "out.xml").findall("worldbody/geom")
    assert [(each.get("type"), each.get("size")) for each in stands_on][-1] == ("cylinder", "0.05 0.1")


def test_an_unknown_rotor_is_that_of_its_servo() -> None:
    """A rotor that is part of a sum must not be taken for a tiny one, which makes the link too heavy instead."""
    joints = [
        SimpleNamespace(servo="XM430-W350", servos=1),
        SimpleNamespace(servo="unknown", servos=1),
        SimpleNamespace(servo="XL430-W250", servos=1),
        SimpleNamespace(servo="XM430-W350", servos=2),
    ]
    model: Any = SimpleNamespace(joints=joints, values={"armature_3": 0.004})
    rotors = [_rotor(model, number) for number in (1, 2, 3, 4)]
    one = servo_prior(servo_model("XM430-W350")).armature.median
    assert rotors == pytest.approx([one, 0.01, 0.004, 2.0 * one])
    assert rotors[0] > 5e-3


def test_groups_that_differ_by_rounding_are_the_same(base: BaseParameters) -> None:
    groups = groups_of(base)
    assert _same_groups(base, groups)
    factor, name = next((word, n) for n, group in groups.items() for word in group.split() if word[0].isdigit())
    assert _same_groups(base, groups | {name: groups[name].replace(factor, f"{float(factor) * (1 + 1e-6)!r}")})
    assert not _same_groups(base, groups | {name: groups[name].replace(factor, f"{float(factor) * 1.01!r}")})
    assert not _same_groups(base, groups | {name: name})
    assert not _same_groups(base, {other: group for other, group in groups.items() if other != name})


def test_a_run_with_other_groups_has_to_be_estimated_again(base: BaseParameters) -> None:
    config = load_config(CONFIGS / "leg.toml")
    groups = groups_of(base)
    name = max(groups, key=lambda each: len(groups[each]))
    values = dict.fromkeys(base.names, 0.01)
    geometry = SimpleNamespace(
        **{key: np.array(getattr(base.chain, key)) for key in ("rotation", "translation", "axis", "gravity")}
    )
    model = SimpleNamespace(
        joints=config.joints, geometry=geometry, values=values, stds=values, groups=groups | {name: name}
    )
    source = SimpleNamespace(run=Path(CONFIGS), result=SimpleNamespace(chain=SimpleNamespace(urdf="leg.urdf")))
    with pytest.raises(ExportError, match="estimate again"):
        chain_links(cast("Any", source), cast("Any", model))
