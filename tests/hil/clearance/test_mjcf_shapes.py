"""Shapes of an MJCF file: where MuJoCo itself has them, on the link that carries them."""

from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hil.clearance.shapes import shapes_of, solids_of
from hil.description.files import read_arm

JOINTS = ["turn", "lift", "bend"]
TEXT = """<mujoco><compiler angle="degree"/>
<default><default class="arm"><joint axis="0 1 0" range="-90 90"/><geom type="capsule" density="900"/>
<default class="looks">
<geom type="box" contype="0" conaffinity="0" density="0" size=".3 .3 .3"/></default></default></default>
<asset><mesh name="wedge" vertex="0 0 0  .06 0 0  0 .04 0  0 0 .02"/></asset>
<worldbody><geom type="plane" size="1 1 .1"/>
<body name="post" childclass="arm">
<geom name="post" type="cylinder" size=".04 .03" pos="0 0 .03"/>
<body name="a" pos="0 0 .06" euler="0 0 30"><joint name="turn" axis="0 0 1"/>
<geom name="a" fromto="0 0 0 .01 0 .05" size=".02"/>
<geom class="looks"/>
<body name="b" pos="0 .01 .06"><joint name="lift" pos="0 0 .01"/>
<geom name="b" fromto="0 .02 .02 0 .03 .14" size=".018"/>
<body name="b2" pos="0 0 .05" euler="20 0 0"><geom name="b2" type="box" size=".02 .01 .03" pos=".01 0 0"/></body>
<body name="c" pos="0 0 .16" euler="0 40 0"><joint name="bend" axis="1 0 0"/>
<geom name="c" type="mesh" mesh="wedge" pos="0 0 .02"/>
<geom name="tip" type="sphere" size=".012" pos="0 .01 .08"/>
</body></body></body></body></worldbody></mujoco>"""


def frames(path: Path, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Orientation and origin of the base and of every link in the world."""
    turn, place = np.eye(3), np.zeros(3)
    found = [(turn, place)]
    for rotation, translation, axis, angle in zip(*read_arm(path, JOINTS).geometry, q, strict=True):
        place = place + turn @ translation
        turn = turn @ rotation @ Rotation.from_rotvec(axis * angle).as_matrix()
        found.append((turn, place))
    return found


def test_shapes_move_as_in_mujoco_and_pictures_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(TEXT, encoding="utf-8")
    arm = read_arm(path, JOINTS)
    solids = solids_of(arm)
    assert [each.link for each in solids] == [0, 1, 2, 2, 3, 3]
    assert [each.kind for each in solids] == ["cylinder", "capsule", "capsule", "box", "mesh", "sphere"]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = q = np.array([0.4, -0.7, 0.9])
    mujoco.mj_kinematics(model, data)
    at = frames(path, q)
    for name, solid in zip(["post", "a", "b", "b2", "c", "tip"], solids, strict=True):
        turn, place = at[solid.link]
        if name != "c":  # MuJoCo puts a mesh's frame into its centre of mass
            np.testing.assert_allclose(turn @ solid.translation + place, data.geom(name).xpos, atol=1e-9)
            np.testing.assert_allclose(turn @ solid.rotation, data.geom(name).xmat.reshape(3, 3), atol=1e-9)


def test_capsules_enclose_the_mesh_too(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(TEXT, encoding="utf-8")
    found = shapes_of(read_arm(path, JOINTS))
    assert found.guessed == ()
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = q = np.array([-0.3, 0.5, -1.1])
    mujoco.mj_kinematics(model, data)
    geom = data.geom("c")
    corners = model.mesh("wedge").vertadr[0] + np.arange(model.mesh("wedge").vertnum[0])
    points = model.mesh_vert[corners] @ geom.xmat.reshape(3, 3).T + geom.xpos
    turn, place = frames(path, q)[3]
    for point in (points - place) @ turn:
        gaps = []
        for capsule in found.capsules:
            if capsule.link == 3:
                start, end = capsule.ends
                along = np.clip((point - start) @ (end - start) / max((end - start) @ (end - start), 1e-12), 0.0, 1.0)
                gaps.append(np.linalg.norm(point - start - along * (end - start)) - capsule.radius)
        assert min(gaps) < 1e-9
