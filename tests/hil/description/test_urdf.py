"""URDF files: geometry and inertias as in other programs, and an error message for every fault."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hil.config.chain import doubted_inertias
from hil.description.arm import ArmFileError, Body
from hil.description.urdf import read_urdf
from tests.support.chains import random_urdf
from tests.support.paths import CONFIGS

HEAD = '<robot name="arm"><link name="base"/>'
INERTIAL = (
    '<inertial><mass value="{mass}"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def link(name: str, mass: float = 0.2) -> str:
    return f'<link name="{name}">{INERTIAL.format(mass=mass)}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = '<axis xyz="0 0 1"/>') -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


TWO = HEAD + link("upper") + link("lower") + joint("shoulder", "base", "upper") + joint("elbow", "upper", "lower")


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("joints", [1, 3, 6])
def test_links_are_where_mujoco_has_them(joints: int, tmp_path: Path) -> None:
    path = written(tmp_path, random_urdf(joints, 10 + joints))
    arm, model = read_urdf(path), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = angles = np.linspace(-2.0, 2.0, joints)
    mujoco.mj_forward(model, data)
    turn, at = np.eye(3), np.zeros(3)
    for index, each in enumerate(arm.joints):
        at, turn = at + turn @ each.translation, turn @ each.rotation
        np.testing.assert_allclose(turn @ each.axis, data.xaxis[index], atol=1e-9)
        np.testing.assert_allclose(at, data.xanchor[index], atol=1e-9)
        x, y, z = each.axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = turn @ (np.eye(3) + np.sin(angles[index]) * cross + (1 - np.cos(angles[index])) * cross @ cross)
        body = model.body(each.link)
        assert each.body.mass == pytest.approx(float(body.mass[0]))
        np.testing.assert_allclose(at + turn @ each.body.centre, data.xipos[body.id], atol=1e-9)
    assert [each.name for each in arm.joints] == [model.joint(i).name for i in range(joints)]
    assert arm.joints[-1].fixed == ("tip",)


def test_the_bundled_arms_are_physical() -> None:
    for path in CONFIGS.glob("*.urdf"):
        arm = read_urdf(path)
        assert not arm.doubts
        assert all(each.body.is_physical for each in arm.joints)


def test_a_gripper_is_held_and_counted_in_its_link(tmp_path: Path) -> None:
    finger = link("finger", 0.1) + joint("grip", "lower", "finger", "prismatic")
    mimic = link("other", 0.1) + joint("grip_2", "lower", "other", "prismatic", '<mimic joint="grip"/>')
    arm = read_urdf(written(tmp_path, TWO + finger + mimic + "</robot>"), ["shoulder", "elbow"])
    assert arm.held == ("grip", "grip_2")
    assert arm.joints[1].body.mass == pytest.approx(0.4)
    assert arm.joints[1].fixed == ("finger", "other")
    assert set(arm.joints[1].movable) == {"finger", "other"} and not arm.joints[0].movable
    whole = arm.joints[1].body
    for each in arm.joints[1].movable.values():
        assert each.mass == pytest.approx(0.1)
        whole = whole.joined(Body(-each.mass, each.centre, -each.inertia))
    alone = read_urdf(written(tmp_path, TWO + "</robot>"), ["shoulder", "elbow"]).joints[1].body
    np.testing.assert_allclose(whole.parameters, alone.parameters, atol=1e-12)


def test_a_negative_moment_of_inertia_is_named(tmp_path: Path) -> None:
    odd = TWO.replace('iyy="1e-3"', 'iyy="-1e-3"', 1)
    with pytest.raises(ArmFileError, match=r'link "upper": its iyy is -0\.001'):
        read_urdf(written(tmp_path, odd + "</robot>"))


def test_an_inertia_that_no_body_has_is_a_doubt(tmp_path: Path) -> None:
    odd = TWO.replace('ixx="1e-3"', 'ixx="9e-3"', 1)
    arm = read_urdf(written(tmp_path, odd + "</robot>"))
    (warning,) = doubted_inertias(arm)
    assert warning == f"{arm.path.name}: {arm.doubts[0]}." and "upper" in warning


PLACEHOLDER = INERTIAL.format(mass=1.0).replace("1e-3", "1")
FOLLOWER = link("tip") + joint("wrist", "lower", "tip", more='<mimic joint="elbow"/>')


@pytest.mark.parametrize(
    ("old", "new", "doubt"),
    [
        ('link="lower"/><axis', 'link="lower"/><origin rpy="0 90 0"/><axis', 'joint "elbow" .* rpy="0 90 0".* degrees'),
        (
            INERTIAL.format(mass=0.2),
            PLACEHOLDER,
            'link "upper" is about 0.1 m long, .* 1.2 m .*placeholder',
        ),
        ("1e-3", "0", 'link "upper" has a mass but an <inertia> of zero'),
        ("", FOLLOWER, 'joint "wrist" mimics "elbow", so its link moves with the arm'),
    ],
    ids=["degrees", "placeholder", "no inertia", "mimic"],
)
def test_what_is_probably_not_meant_is_a_doubt(old: str, new: str, doubt: str, tmp_path: Path) -> None:
    odd = TWO.replace(old, new, 3 if old == "1e-3" else 1) if old else TWO + new
    (said,) = read_urdf(written(tmp_path, odd + "</robot>"), ["shoulder", "elbow"]).doubts
    assert re.search(doubt, said)


@pytest.mark.parametrize(
    ("text", "joints", "message"),
    [
        (TWO + link("x"), None, "have no parent joint"),
        (TWO + joint("back", "lower", "upper"), None, "loop"),
        (TWO + "".join(f'<link name="l{n}"/>' for n in range(498)), None, "501 links; at most 500 are allowed"),
        (TWO + '<link name="stray"/>' + joint("own", "stray", "stray"), None, "is both its parent and its child"),
        (
            joint("a", "u", "l").join(
                (HEAD.replace('<link name="base"/>', ""), link("u") + link("l") + joint("b", "l", "u"))
            ),
            None,
            "loop",
        ),
        (TWO, ["shoulder", "wrist"], 'no joint "wrist".*shoulder, elbow'),
        (TWO, ["elbow", "shoulder"], "from the base, the joints are shoulder, elbow"),
        (TWO, ["elbow"], '"shoulder" .revolute. lies before'),
        (TWO, ["elbow", "elbow"], "named twice"),
        (TWO + link("y") + joint("slide", "lower", "y", "prismatic"), ["shoulder", "elbow", "slide"], "prismatic"),
        (
            TWO + link("y") + joint("m", "lower", "y", more='<axis xyz="0 0 1"/><mimic joint="elbow"/>'),
            ["shoulder", "elbow", "m"],
            'mimics "elbow"',
        ),
        (TWO + link("y") + joint("m", "upper", "y"), None, "branches"),
        (TWO.replace('xyz="0 0 1"', 'xyz="0 0 2"', 1), None, "length 2"),
        (TWO.replace('xyz="0 0 1"', 'xyz="0 1"', 1), None, "three numbers"),
        (TWO.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><origin xyz="128 0 0"/>'), None, "millimetres"),
        (TWO.replace('value="0.2"', 'value="200"'), None, "grams"),
        (TWO.replace('value="0.2"', 'value="-1"'), None, "negative"),
        (TWO.replace('value="0.2"', 'value="heavy"'), None, "must be a number"),
        (HEAD + '<link name="upper"/>' + joint("shoulder", "base", "upper"), None, '"upper".*no mass'),
        (TWO.replace('type="revolute"', 'type="spherical"'), None, "spherical"),
        (HEAD, None, "no joint rotates"),
        ("<mujoco>", None, "not a URDF"),
        ('<!DOCTYPE robot [<!ENTITY a "b">]>' + TWO, None, "entities"),
        (TWO + '<xacro:arm xmlns:xacro="x"/>', None, "xacro"),
        (TWO + "<", None, "not XML"),
        (TWO + '<joint type="fixed"/>', None, "no name"),
        (TWO + joint("j", "lower", "nowhere"), None, "'nowhere' is not in the file"),
    ],
)
def test_what_is_wrong_is_named(text: str, joints: list[str] | None, message: str, tmp_path: Path) -> None:
    end = "</mujoco>" if text.startswith("<mujoco") else "</robot>"
    with pytest.raises(ArmFileError, match=message):
        read_urdf(written(tmp_path, text + end), joints)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ArmFileError, match=r"none\.urdf cannot be read"):
        read_urdf(tmp_path / "none.urdf")
    (tmp_path / "wide.urdf").write_text(TWO + "</robot>", encoding="utf-16")
    with pytest.raises(ArmFileError, match="not UTF-8 text; save it as UTF-8"):
        read_urdf(tmp_path / "wide.urdf")
