"""A planar arm described by a URDF: if its angles follow the planar model's convention, nothing changes."""

from pathlib import Path

import pytest

from hil.config.schema import Config, load_config, parse_config
from hil.errors import ConfigError
from tests.support.paths import CONFIGS

TOML = (CONFIGS / "fake_two_link.toml").read_text(encoding="utf-8")
LINK = (
    '<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="0.2"/>'
    '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


def urdf(axis: str = "0 -1 0", second: str = "0 -1 0", turned: str = "0 0 0", elbow: str = "elbow") -> str:
    joints = (
        f'<joint name="shoulder" type="revolute"><parent link="base"/><child link="one"/><origin rpy="{turned}"/>'
        f'<axis xyz="{axis}"/><limit lower="-4" upper="4" velocity="9" effort="9"/></joint>'
        f'<joint name="{elbow}" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.2 0 0"/>'
        f'<axis xyz="{second}"/><limit lower="-4" upper="4" velocity="9" effort="9"/></joint>'
    )
    return f'<robot name="arm"><link name="base"/>{LINK.format(name="one")}{LINK.format(name="two")}{joints}</robot>'


def config(folder: Path, text: str) -> Config:
    (folder / "arm.urdf").write_text(text, encoding="utf-8")
    (folder / "arm.toml").write_text(TOML.replace("[arm]", '[arm]\nurdf = "arm.urdf"'), encoding="utf-8")
    return load_config(folder / "arm.toml")


def test_a_planar_arm_stays_planar(tmp_path: Path) -> None:
    assert not config(tmp_path, urdf()).is_chain


def test_its_base_may_be_turned(tmp_path: Path) -> None:
    assert not config(tmp_path, urdf(turned="0 0 1.2")).is_chain


@pytest.mark.parametrize(
    "text",
    [
        urdf(second="0 1 0"),  # the elbow's angle increases the other way
        urdf(axis="0 1 0", second="0 1 0"),  # positive angles lower the arm
        urdf(turned="0 0.3 0"),  # the first link is not horizontal at angle zero
        urdf(second="1 0 0"),
        urdf(turned="0.5 0 0"),  # gravity has a part along the axes
    ],
)
def test_any_other_is_an_arm_in_space(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="stabiliser is missing"):
        config(tmp_path, text)


def test_joints_that_the_file_does_not_know_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match='has no joint "elbow"; the rotating joints are shoulder, forearm'):
        config(tmp_path, urdf(elbow="forearm"))


def test_lengths_beside_the_description_of_a_spatial_arm_are_refused() -> None:
    text = (CONFIGS / "leg.toml").read_text(encoding="utf-8")
    twice = text.replace("rest_pose =", "link_lengths = [0.1, 0.1, 0.1]\nrest_pose =", 1)
    with pytest.raises(ConfigError, match=r"arm\.link_lengths: a spatial arm takes its lengths from arm\.urdf"):
        parse_config(twice, CONFIGS / "leg.toml")
