"""Clearance of a spatial arm: capsules around its links, distances from itself, the floor and boxes."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from hil.clearance.doubts import doubts
from hil.clearance.mesh import find_mesh
from hil.clearance.shapes import shapes_of
from hil.clearance.space import Space
from hil.config.schema import Config, load_config
from hil.description.arm import ArmFileError
from hil.description.urdf import read_urdf
from hil.errors import ConfigError
from tests.support.paths import CONFIGS

TEXT = (CONFIGS / "open_manipulator_x.toml").read_text(encoding="utf-8")


def configured(folder: Path, text: str) -> Config:
    urdf = "open_manipulator_x_like.urdf"
    (folder / urdf).write_bytes((CONFIGS / urdf).read_bytes())
    (folder / "arm.toml").write_text(text, encoding="utf-8")
    return load_config(folder / "arm.toml")


def points(ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Many points within capsules (capsules, points, 3): along their axes, the radius left to the test."""
    share = np.linspace(0.0, 1.0, 60)[:, None]
    return np.stack([a + share * (b - a) for a, b in ends])


def test_distances_are_those_of_many_points() -> None:
    config = load_config(CONFIGS / "viperx_300.toml")
    space = Space.of(config)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    for pose in np.random.default_rng(1).uniform(low, high, (20, len(low))):
        ends, radius = space.ends(pose)
        cloud = points(ends, radius)
        least = np.inf
        for (a, b), needed in zip(space._pairs, space._needed(False), strict=True):
            if b >= 0:
                apart = np.linalg.norm(cloud[a][:, None] - cloud[b][None], axis=-1).min() - radius[a] - radius[b]
            else:
                apart = ends[a, :, 2].min() - radius[a]
            least = min(least, apart - needed)
        assert space.nearest(pose[:, None]).room == pytest.approx(least, abs=2e-3)


def test_a_box_in_the_way_is_named(tmp_path: Path) -> None:
    box = '\n[[clearance.boxes]]\nname = "camera"\ncentre = [0.25, 0.0, 0.2]\nsize = [0.1, 0.1, 0.1]\n'
    space = Space.of(configured(tmp_path, TEXT.replace("\n[experiment]", f"{box}\n[experiment]", 1)))
    reaching = np.array([[0.0, 0.0, 0.0, 0.0]]).T
    nearest = space.nearest(reaching)
    assert nearest.distance < 0.0
    assert "camera" in nearest.pair
    aside = np.array([[1.5, 0.0, 0.0, 0.0]]).T
    assert space.nearest(aside).distance > 0.01


def test_the_floor_can_be_elsewhere_or_missing(tmp_path: Path) -> None:
    down = np.array([[0.0, 1.5, 0.3, 0.0]]).T
    near = Space.of(configured(tmp_path, TEXT)).nearest(down)
    assert near.pair[1] == "floor"
    assert near.distance < 0.0
    lower = Space.of(configured(tmp_path, TEXT.replace("floor = 0.0 ", "floor = -1.0 "))).nearest(down)
    assert lower.distance > 0.0
    none = Space.of(configured(tmp_path, TEXT.replace("floor = 0.0 ", 'floor = "none" ')))
    assert none.nearest(down).pair[1] != "floor"


def test_an_unknown_name_to_ignore_is_named(tmp_path: Path) -> None:
    text = TEXT.replace("[clearance]\n", '[clearance]\nignore = [["hand", "flor"]]\n', 1)
    with pytest.raises(ConfigError, match=r"clearance.ignore: 'flor' is not a known name; allowed names are .*floor"):
        configured(tmp_path, text)


def test_where_it_lies_it_may_be_near_but_not_nearer(tmp_path: Path) -> None:
    config = configured(tmp_path, TEXT)
    space, rest = Space.of(config), np.array(config.arm.rest_pose)[:, None]
    assert space.nearest(rest).room < 0.0
    assert space.room(rest, on_the_way=True)[0] >= 0.0
    folded = rest + np.array([[0.0], [-0.05], [0.05], [0.6]])
    assert space.room(folded, on_the_way=True)[0] < 0.0


def test_parts_near_each_other_by_design_must_not_touch() -> None:
    config = load_config(CONFIGS / "fake_viperx_300.toml")
    space = Space.of(config)
    assert ("base", "upper_arm_link") in space.near and not space.as_built
    needed = space._needed(False)
    assert {space.names_of(int(pair)) for pair in np.flatnonzero(needed == 0.0)} == set(space.near)
    assert set(needed) == {0.0, space.margin}


def test_only_parts_nearly_always_within_the_margin_are_left_out_and_named() -> None:
    config = load_config(CONFIGS / "koch.toml")
    assert not Space.of(config).as_built
    wide = config.model_copy(update={"clearance": config.clearance.model_copy(update={"margin": 0.015})})
    assert Space.of(wide).as_built == (("base", "upper_arm"),)
    said = "Some parts of 'base' and 'upper_arm' are closer than clearance.margin in nearly every pose"
    assert any(said in doubt for doubt in doubts(wide))
    assert not any("nearly every pose" in doubt for doubt in doubts(config))


def test_the_reserve_of_parts_near_each_other_by_design_is_one_they_can_keep() -> None:
    config = load_config(CONFIGS / "koch.toml")
    space = Space.of(config)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    poses = np.random.default_rng(1).uniform(low, high, (200, len(low)))
    assert any(space.has_reserve(pose[:, None], 0.01) for pose in poses)
    assert not any(space.has_reserve(pose[:, None], 0.5) for pose in poses)


def test_capsules_enclose_boxes_and_meshes(tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (0.0, 0.2) for y in (-0.03, 0.03) for z in (-0.01, 0.01)])
    triangles = corners[[[0, 1, 2], [3, 4, 5], [5, 6, 7]]]
    stl = b"\0" * 80 + struct.pack("<I", 3)
    stl += b"".join(np.zeros(3, "<f4").tobytes() + t.astype("<f4").tobytes() + b"\0\0" for t in triangles)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "link.stl").write_bytes(stl)
    assert find_mesh("package://robot/meshes/link.stl", tmp_path / "arm.urdf") == tmp_path / "meshes" / "link.stl"
    for geometry in ('<mesh filename="package://robot/meshes/link.stl"/>', '<box size="0.2 0.06 0.02"/>'):
        origin = "0 0 0" if "mesh" in geometry else "0.1 0 0"
        arm = one_joint(tmp_path, f'<collision><origin xyz="{origin}"/><geometry>{geometry}</geometry></collision>')
        shapes = shapes_of(arm)
        assert "tip" not in shapes.guessed
        for corner in corners:
            assert min(outside(corner, each.ends, each.radius) for each in shapes.capsules) < 1e-6


@pytest.mark.parametrize(
    ("mesh", "why"),
    [
        ("package://a/b.stl", "no such file"),
        ("shape.dae", "only STL and OBJ"),
        ("empty.stl", "no vertices"),
        ("broken.obj", "is damaged"),
    ],
)
def test_what_cannot_be_read_is_guessed_and_named(tmp_path: Path, mesh: str, why: str) -> None:
    for name, text in (("shape.dae", "<COLLADA/>"), ("empty.stl", ""), ("broken.obj", "v 1 2 three")):
        (tmp_path / name).write_text(text, encoding="utf-8")
    shapes = shapes_of(one_joint(tmp_path, f'<collision><geometry><mesh filename="{mesh}"/></geometry></collision>'))
    assert "tip" in shapes.guessed and shapes.capsules
    (doubt,) = shapes.doubts
    assert doubt.startswith(f'link "tip": its mesh "{mesh}" is not used: ') and why in doubt
    assert "A capsule 200 mm long from its joint to its end is used instead. The radius of 40 mm is a guess" in doubt


def test_a_base_whose_shape_cannot_be_read_has_none(tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="base.stl"/></geometry></collision>'
    box = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    one_joint(tmp_path, box)
    path = tmp_path / "arm.urdf"
    path.write_text(path.read_text(encoding="utf-8").replace('<link name="base"/>', f'<link name="base">{mesh}</link>'))
    (doubt,) = shapes_of(read_urdf(path, ["j"])).doubts
    assert doubt.startswith('link "base"') and "It has no shape: the clearance to it is unknown." in doubt


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ('<sphere radius="wide"/>', "radius='wide' must be a number"),
        ('<box size="0.1 -0.1 0.1"/>', 'a box in its geometry has size="0.1 -0.1 0.1", but lengths [m] cannot'),
        ('<box size="0.1 0.1"/>', 'size="0.1 0.1" must be three numbers'),
        ('<cylinder radius="0.1"/>', "a cylinder in its geometry has no length"),
        ('<mesh filename="a.stl" scale="0.001"/>', 'scale="0.001" must be three numbers'),
    ],
)
def test_a_wrong_size_is_named(tmp_path: Path, shape: str, said: str) -> None:
    with pytest.raises(ArmFileError, match=re.escape(f'link "tip": {said}')):
        one_joint(tmp_path, f"<collision><geometry>{shape}</geometry></collision>")


LIMITS = '<limit lower="-0.94" upper="1.38"'


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ((LIMITS, '<limit lower="1.38" upper="-0.94"'), "the lower limit must come first"),
        ((LIMITS, '<limit lower="0.5" upper="0.5"'), "they are equal"),
        ((LIMITS, '<limit lower="-0.94" upper="0.9"'), "but position_limit lets it move from"),
        (('iyy="', 'iyy="9'), "no mass distribution can have this inertia"),
        ((LIMITS, '<limit lower="-80" upper="80"'), "are these degrees? Limits must be in radians: [-1.4, 1.4]"),
        (("<inertia ", "<no_inertia "), "has a mass but no <inertia>"),
        (("<box size=", "<mesh filename="), "is used instead"),
        (("", ""), ""),
    ],
)
def test_doubts_about_a_description(tmp_path: Path, edit: tuple[str, str], said: str) -> None:
    config = configured(tmp_path, TEXT)
    path = Path(str(config.arm.urdf))
    text = path.read_text(encoding="utf-8")
    assert edit[0] in text
    path.write_text(text.replace(*edit), encoding="utf-8")
    found = list(doubts(load_config(config.path)))
    assert any(said in doubt for doubt in found) if said else not found


def test_a_mesh_in_millimetres_is_named(tmp_path: Path) -> None:
    corners = "".join(f"v {x} {y} {z}\n" for x in (0, 160) for y in (0, 40) for z in (0, 40))
    (tmp_path / "part.obj").write_text(corners, encoding="utf-8")
    shape = '<collision><geometry><mesh filename="part.obj"{}/></geometry></collision>'
    (doubt,) = shapes_of(one_joint(tmp_path, shape.format(""))).doubts
    assert 'it is 160 m long; if the file is in millimetres, add scale="0.001 0.001 0.001"' in doubt
    assert not shapes_of(one_joint(tmp_path, shape.format(' scale="0.001 0.001 0.001"'))).doubts


def test_a_limit_that_cannot_overcome_friction_is_doubted(tmp_path: Path) -> None:
    text, changed = re.subn(r"(?m)^current_limit = \S+", "current_limit = 0.001", TEXT, count=1)
    (doubt,) = doubts(configured(tmp_path, text))
    assert changed and "current_limit of joint 'joint1' = 0.001 A" in doubt
    assert "The joint probably would not move" in doubt


@pytest.mark.parametrize(("turns", "doubted"), [(1, True), ([1, 1], True), ([1, -1], False)])
def test_two_servos_that_turn_the_same_way_are_doubted(tmp_path: Path, turns: object, doubted: bool) -> None:
    config = configured(tmp_path, TEXT)
    second = config.joints[1].model_copy(update={"servos": [12, 22], "turns": turns})
    found = list(doubts(config.model_copy(update={"joints": [config.joints[0], second, *config.joints[2:]]})))
    assert any("they work against each other. Only motion shows which" in each for each in found) is doubted


def one_joint(folder: Path, collision: str):  # type: ignore[no-untyped-def]
    path = folder / "arm.urdf"
    path.write_text(
        '<robot name="a"><link name="base"/><joint name="j" type="revolute"><parent link="base"/><child link="tip"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint><link name="tip"><inertial>'
        '<origin xyz="0.1 0 0"/><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
        f"</inertial>{collision}</link></robot>",
        encoding="utf-8",
    )
    return read_urdf(path, ["j"])


def outside(point: np.ndarray, ends: np.ndarray, radius: float) -> float:
    along = ends[1] - ends[0]
    share = np.clip((point - ends[0]) @ along / max(along @ along, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(point - ends[0] - share * along) - radius)
