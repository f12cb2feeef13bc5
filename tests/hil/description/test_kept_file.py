"""What a run folder keeps of an arm's file can be read alone and describes the same arm."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from hil.description.files import read_arm
from hil.description.kept_file import kept_bytes
from tests.support.paths import CONFIGS

JOINTS = ["lift", "bend"]
TEXT = """<mujoco><compiler angle="degree" meshdir="parts"/>
<asset><mesh name="wedge" file="wedge.obj"/><texture name="t" type="2d" builtin="checker" width="8" height="8"/>
<material name="m" texture="t"/></asset>
<default><default class="seen"><geom type="mesh" mesh="wedge" density="500" material="m"/></default></default>
<worldbody><include file="arm_body.xml"/></worldbody></mujoco>"""
BODY = """<mujocoinclude><body name="a" pos="0 0 .1"><joint name="lift" axis="0 1 0" range="-90 90"/>
<geom class="seen"/><geom type="capsule" fromto="0 0 0 0 0 .1" size=".02" material="m"/>
<body name="b" pos="0 0 .12" euler="10 0 0"><joint name="bend" axis="1 0 0"/><geom class="seen" pos="0 0 .03"/>
</body></body></mujocoinclude>"""
WEDGE = "v 0 0 0\nv .06 0 0\nv 0 .04 0\nv 0 0 .05\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_an_mjcf_with_meshes_and_includes_is_kept_in_one_file(tmp_path: Path) -> None:
    there, alone = tmp_path / "there", tmp_path / "alone"
    (there / "parts").mkdir(parents=True)
    alone.mkdir()
    (there / "arm.xml").write_text(TEXT, encoding="utf-8")
    (there / "arm_body.xml").write_text(BODY, encoding="utf-8")
    (there / "parts" / "wedge.obj").write_text(WEDGE, encoding="utf-8")
    (alone / "arm.xml").write_bytes(kept_bytes(there / "arm.xml"))
    one, other = (read_arm(folder / "arm.xml", JOINTS) for folder in (there, alone))
    np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-5, atol=1e-9)
    for mine, its in zip(one.geometry, other.geometry, strict=True):
        np.testing.assert_allclose(its, mine, atol=1e-5)
    assert other.joints[0].limits == pytest.approx(one.joints[0].limits, abs=1e-5)
    assert other.joints[1].limits is None
    assert mujoco.MjModel.from_xml_path(str(alone / "arm.xml")).ngeom == 1


@pytest.mark.parametrize("text", ["<mujoco><worldbody/></mujoco>"])
def test_other_files_are_kept_byte_for_byte(text: str, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    assert kept_bytes(tmp_path / "arm.xml") == text.encode()
    urdf = CONFIGS / "leg.urdf"
    assert kept_bytes(urdf) == urdf.read_bytes()
