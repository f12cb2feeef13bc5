"""MJCF as MuJoCo reads it, compared with the same arm's URDF; and error messages for invalid files."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from hil.config.chain import doubted_gravity
from hil.description.arm import ArmFileError
from hil.description.files import read_arm
from hil.estimator.chain.model.dynamics import inverse_dynamics
from hil.estimator.chain.model.geometry import Chain
from tests.support.chains import random_urdf

GRAVITY = np.array([0.0, 0.0, -9.81])
ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="upper" pos="0 0 0.1" euler="0 0.3 0">
<joint name="one" axis="0 0 2" pos="0.01 0.02 0" ref="0.4"/>
<inertial pos="0 0 0.1" mass="0.3" diaginertia="1e-3 2e-3 2e-3"/>
<body name="lower" pos="0.2 0 0" quat="0.9 0.1 0.2 0"><joint name="two" axis="0 1 0" pos="0 0 -0.03" range="-1 1"/>
<inertial pos="0.1 0 0" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
<body name="jaw" pos="0.1 0 0"><joint name="gripper" type="slide" axis="1 0 0"/>
<inertial pos="0 0.01 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/></body></body></body></worldbody>{more}</mujoco>"""


def torque(path: Path, joints: list[str], q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    arm = read_arm(path, joints)
    every = np.column_stack((arm.parameters, np.zeros(len(joints)))).reshape(-1)
    return inverse_dynamics(Chain(*arm.geometry, GRAVITY), every, q, v, a)


def doubts_of(folder: Path, old: str, new: str) -> tuple[str, ...]:
    path = folder / "arm.xml"
    assert old in ARM
    path.write_text(ARM.replace(old, new, 1).format(more=""))
    return read_arm(path, ["one", "two"]).doubts


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name="two"', 'name="two" stiffness="3"', 'joint "two" has a stiffness, but springs are not modelled'),
        ('name="jaw"', 'name="jaw" gravcomp="1"', 'body "jaw" has gravcomp, which is not used'),
        (
            "</worldbody>",
            '</worldbody><tendon><fixed stiffness="5"><joint joint="two" coef="1"/></fixed></tendon>',
            "tendons and springs are not modelled",
        ),
        ("", "", ""),
    ],
)
def test_physics_that_is_not_modelled_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    found = doubts_of(tmp_path, old, new)
    assert any(said in doubt for doubt in found) if said else not found


@pytest.mark.parametrize(
    ("option", "base", "said"),
    [
        ("9.81 0 0", [0.0, 0.0, 0.0], "set base = [0.0, 1.5708, 0.0] and gravity = 9.81 under [arm]"),
        ("9.81 0 0", [0.0, 1.5708, 0.0], ""),
        ("0 0 0", [0.0, 0.0, 0.0], "sets gravity to zero"),
        ("0 0 -9.81", [0.0, 1.0, 0.0], ""),  # MuJoCo's default, which says nothing about the arm
    ],
)
def test_another_gravity_than_the_configuration_is_named(
    tmp_path: Path, option: str, base: list[float], said: str
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace("<worldbody>", f'<option gravity="{option}"/><worldbody>').format(more=""))
    arm = SimpleNamespace(urdf=str(path), base=base, gravity=9.81)
    config: Any = SimpleNamespace(arm=arm, joints=[SimpleNamespace(name=name) for name in ("one", "two")])
    found = list(doubted_gravity(config))
    assert said in found[0] if said else not found


def test_an_arm_is_the_same_from_urdf_and_from_mjcf(tmp_path: Path) -> None:
    names = [f"joint_{n + 1}" for n in range(5)]
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(random_urdf(5, 3))
    model = mujoco.MjModel.from_xml_path(str(urdf))
    mujoco.mj_saveLastXML(str(tmp_path / "arm.xml"), model)
    motion = np.random.default_rng(1).standard_normal((3, 5, 20))
    right = torque(urdf, names, *motion)
    np.testing.assert_allclose(torque(tmp_path / "arm.xml", names, *motion), right, rtol=2e-3, atol=2e-3)


def test_pivots_references_and_a_held_gripper_are_those_of_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(more=""))
    arm = read_arm(path, ["one", "two"])
    assert arm.held == ("gripper",)
    assert arm.joints[1].limits == (-1.0, 1.0)
    assert arm.joints[1].fixed == ("jaw",)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(2)
    for _ in range(5):
        q, v, a = rng.standard_normal((3, 2))
        data.qpos[:], data.qvel[:], data.qacc[:] = [*q, 0.0], [*v, 0.0], [*a, 0.0]
        model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        mujoco.mj_inverse(model, data)
        found = torque(path, ["one", "two"], *(each[:, None] for each in (q, v, a)))
        np.testing.assert_allclose(found[:, 0], data.qfrc_inverse[:2], atol=1e-10)


@pytest.mark.parametrize(
    ("more", "joints", "message"),
    [
        ("", ["one", "three"], 'has no joint "three"; the rotating joints are one, two'),
        ("", ["one", "two", "gripper"], 'joint "gripper" is of type slide: only hinge joints'),
        ("", ["two"], 'a joint before "two"'),
        ("", ["two", "one"], 'joint "two" does not lie'),
        ('<equality><connect body1="jaw" body2="upper" anchor="0 0 0"/></equality>', ["one", "two"], "closes a loop"),
        ('<equality><joint joint1="two" joint2="one"/></equality>', ["one", "two"], "coupled to another"),
        ("<actuator", ["one"], "MuJoCo cannot read it"),
    ],
)
def test_what_is_wrong_is_named(more: str, joints: list[str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(more=more))
    with pytest.raises(ArmFileError, match=message):
        read_arm(path, joints)


def test_without_mujoco_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(more=""))
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ArmFileError, match="pip install"):
        read_arm(path)
