"""The moving spatial arm: in the page's data, and in a real browser as a visitor would view and rotate it."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.clearance.kept import keep_shapes, known_shapes
from hil.clearance.shapes import shapes_of
from hil.clearance.space import Space
from hil.config.chain import described_arm
from hil.config.clearance import BoxConfig
from hil.config.schema import Config, load_config
from hil.report.page import render
from hil.report.scene import spatial_motion
from hil.report.section import Section, SpatialMotion

CONFIG = "wx250s"
RATE = 50.0
YAW, PITCH = -0.9, 0.35  # of the page when it opens
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

_BEFORE = """<script>window.seen = { errors: [] };
addEventListener("error", (event) => seen.errors.push(String(event.message)), true);
addEventListener("securitypolicyviolation", (event) => seen.errors.push("policy: " + event.blockedURI));</script>"""
_AFTER = """<script>addEventListener("load", () => {
  const find = (name) => document.querySelector(`.spatial ${name}`);
  const slider = find("input"), svg = find("svg");
  const place = (circle) => ["cx", "cy"].map((name) => +circle.getAttribute(name));
  const circles = () => [...svg.querySelectorAll("circle")].map(place);
  seen.first = circles();
  seen.kinds = [];
  for (let at = 0; at <= slider.max; at++) {
    slider.value = at;
    slider.dispatchEvent(new Event("input"));
    seen.kinds.push([find(".nearest").className, [...find(".ranges").children].map((row) => row.className)]);
  }
  seen.time = find("output").textContent;
  slider.value = 0;
  slider.dispatchEvent(new Event("input"));
  svg.setPointerCapture = () => {};
  for (const [type, x] of [["pointerdown", 0], ["pointermove", 80], ["pointerup", 80]])
    svg.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: 0, pointerId: 1 }));
  seen.turned = circles();
  svg.dispatchEvent(new MouseEvent("dblclick"));
  seen.back = circles();
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  seen.requests = loaded.filter((name) => !name.startsWith("data:"));
  seen.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const note = document.createElement("pre");
  note.id = "seen";
  note.textContent = JSON.stringify(seen);
  document.body.append(note);
});</script>"""


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(Path(CONFIG))


@pytest.fixture(scope="module")
def position(config: Config) -> np.ndarray:
    """From the rest pose past the upper limit of the first joint, then with the elbow folded into the arm."""
    rest = np.array(config.arm.rest_pose)
    free, beyond, folded = np.zeros_like(rest), np.zeros_like(rest), np.zeros_like(rest)
    beyond[0] = config.joints[0].position_limit[1] + 0.1
    folded[1], folded[2] = -2.0, 2.9
    return np.stack([rest, free, beyond, folded], axis=1)


@pytest.fixture(scope="module")
def moving(config: Config, position: np.ndarray) -> SpatialMotion:
    return spatial_motion(config, position, RATE, "The arm.", (1, 0))


def origins(scene: dict[str, Any], frame: int) -> np.ndarray:
    """Joint origins (joints, 3) in the upright frame, from the page's data."""
    turn, at, found = np.array(scene["upright"]).reshape(3, 3), np.zeros(3), []
    for joint, angles in zip(scene["chain"], scene["angles"], strict=True):
        at = at + turn @ np.array(joint[9:12])
        turn = turn @ np.array(joint[:9]).reshape(3, 3)
        turn = turn @ Rotation.from_rotvec(np.array(joint[12:15]) * angles[frame]).as_matrix()
        found.append(at)
    return np.array(found)


def projected(scene: dict[str, Any], frame: int) -> np.ndarray:
    """Pixels (joints, 2) of the joint origins in the view with which the page opens."""
    x, y, z = (origins(scene, frame) - scene["centre"]).T
    away = np.cos(YAW) * x + np.sin(YAW) * y
    across = np.cos(YAW) * y - np.sin(YAW) * x
    pixels: np.ndarray = 100 / scene["reach"] * np.stack([across, -(np.cos(PITCH) * z - np.sin(PITCH) * away)], axis=1)
    return pixels


def test_clearance_of_each_frame_is_that_of_the_space(
    config: Config, position: np.ndarray, moving: SpatialMotion
) -> None:
    space, scene = Space.of(config), moving.scene
    for frame in range(1, position.shape[1]):
        found = space.nearest(position[:, [frame]])
        assert scene["clearance"][frame] == round(1e3 * min(found.distance, 1.0))
        assert tuple(scene["pairs"][scene["nearest"][frame]]) == found.pair
    assert scene["room"][0] >= 0  # it may lie in its rest pose
    assert scene["room"][3] < 0 < scene["room"][1]


def test_every_capsule_lies_within_the_picture(config: Config, position: np.ndarray, moving: SpatialMotion) -> None:
    space = Space.of(config)
    for pose in position.T:
        ends, radius = space.ends(pose)
        away = np.linalg.norm(ends - np.array(moving.scene["centre"]), axis=2).max(axis=1) + radius
        assert away.max() <= moving.scene["reach"] + 1e-3


def test_a_box_far_from_the_arm_lies_within_the_picture(config: Config, position: np.ndarray) -> None:
    box = BoxConfig(name="wall", size=[0.1, 1.6, 0.9], centre=[0.9, 0.0, 0.45], turned=[0.0, 0.0, 0.4])
    walled = config.model_copy(update={"clearance": config.clearance.model_copy(update={"boxes": [box]})})
    scene = spatial_motion(walled, position, RATE, "The arm.").scene
    turn, at, half = np.split(np.array(scene["boxes"][0]), [9, 12])
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (at + (signs * half) @ turn.reshape(3, 3).T) @ np.array(scene["upright"]).reshape(3, 3).T
    assert np.linalg.norm(corners - scene["centre"], axis=1).max() <= scene["reach"] + 1e-3


def test_a_long_motion_stays_small(config: Config) -> None:
    long = np.sin(np.linspace(0, 9, 60_000)) * np.ones((len(config.joints), 1))
    scene = spatial_motion(config, long, 400.0, "Long.").scene
    assert len(scene["angles"][0]) <= 600
    assert scene["interval"] * len(scene["angles"][0]) == pytest.approx(150.0, rel=0.01)
    assert len(json.dumps(scene)) < 200_000


def test_capsules_kept_beside_a_copy_are_those_of_the_meshes(config: Config, tmp_path: Path) -> None:
    arm = described_arm(config)
    (tmp_path / arm.path.name).write_bytes(arm.path.read_bytes())
    keep_shapes(arm, tmp_path)
    copied = config.model_copy(update={"arm": config.arm.model_copy(update={"urdf": str(tmp_path / arm.path.name)})})
    kept, original = known_shapes(described_arm(copied)), shapes_of(arm)
    assert kept.names == original.names
    for one, other in zip(kept.capsules, original.capsules, strict=True):
        assert one.link == other.link
        np.testing.assert_allclose(one.ends, other.ends)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
@pytest.mark.parametrize("width", [1200, 500])
def test_a_visitor_sees_it_move_and_turns_it(moving: SpatialMotion, tmp_path: Path, width: int) -> None:
    page = render("arm", "2026-01-01T00:00:00", [Section("motion", "The motion", motion=moving)])
    path = tmp_path / "page.html"
    path.write_text(page.replace("<head>", f"<head>{_BEFORE}", 1).replace("</body>", f"{_AFTER}</body>", 1), "utf-8")
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command += [f"--window-size={width},900", "--disable-background-networking", "--dump-dom", path.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    found = re.search(r'<pre id="seen">(.*?)</pre>', dom, re.DOTALL)
    assert found, dom[-2000:]
    seen: dict[str, Any] = json.loads(unescape(found[1]))
    assert seen["errors"] == []
    assert seen["requests"] == []
    assert seen["overflow"] == 0
    expected = projected(moving.scene, 0)
    # Drawn from back to front, so in an order other than that of the joints.
    np.testing.assert_allclose(np.sort(np.array(seen["first"]), axis=0), np.sort(expected, axis=0), atol=0.11)
    assert np.abs(np.array(seen["turned"]) - np.array(seen["first"])).max() > 5
    np.testing.assert_allclose(seen["back"], seen["first"], atol=0.11)
    assert seen["time"] == "0.06 s"
    nearest, ranges = zip(*seen["kinds"], strict=True)
    assert nearest[3] == "nearest near"
    room = moving.scene["room"][1]  # between base and upper arm, which are near each other in every pose
    assert nearest[1] == f"nearest {'free' if room >= 20 else 'about'}"
    assert ranges[2][0] == "near"
    assert ranges[1][0] == "free"
