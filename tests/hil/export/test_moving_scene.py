"""The arm in an MCAP file: frames and shapes read back as a viewer would, for planar and for spatial arms."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.clearance.space import Space
from hil.config.schema import Config, load_config
from hil.export.formats import export
from hil.export.foxglove import scene_message, scene_schema, transform_messages, transforms_schema
from hil.export.moving_scene import moving_scene
from hil.runs.recording import load_samples


class Viewer:
    """Holds the latest transform of each frame, and resolves frames to the world."""

    def __init__(self, message: dict[str, Any]) -> None:
        self._of = {each["child_frame_id"]: each for each in message["transforms"]}

    def place(self, frame: str, point: dict[str, float]) -> np.ndarray:
        at = np.array([point[axis] for axis in "xyz"])
        while frame != "world":
            one = self._of[frame]
            turn = Rotation.from_quat([one["rotation"][axis] for axis in "xyzw"])
            at = turn.apply(at) + [one["translation"][axis] for axis in "xyz"]
            frame = one["parent_frame_id"]
        return np.asarray(at)


def checked(message: Any, schema: dict[str, Any]) -> None:
    """Every field of the message is in the schema, and vice versa."""
    if schema["type"] == "object" and "properties" in schema:
        assert set(message) == set(schema["properties"])
        for name, value in message.items():
            checked(value, schema["properties"][name])
    elif schema["type"] == "array":
        for each in message:
            checked(each, schema["items"])
    else:
        kinds = {"number": float, "integer": int, "string": str, "boolean": bool, "object": dict}
        assert isinstance(message, kinds[schema["type"]])


@pytest.mark.parametrize("name", ["wx250s", "leg", "fake_open_manipulator_x"])
def test_every_capsule_is_where_the_clearance_is_computed(name: str) -> None:
    config = load_config(Path(name))
    tilted = config.arm.model_copy(update={"base": [0.3, -0.2, 0.5]})
    config = config.model_copy(update={"arm": tilted})
    scene, space = moving_scene(config), Space.of(config)
    upright = Rotation.from_euler("xyz", tilted.base).as_matrix()
    angles = np.random.default_rng(1).uniform(-1, 1, (len(config.joints), 3))
    shapes = scene_message(scene, 0)
    checked(shapes, scene_schema())
    for sample, message in enumerate(transform_messages(scene, angles, [0, 1, 2])):
        checked(message, transforms_schema())
        viewer = Viewer(message)
        spheres = [(e["frame_id"], s) for e in shapes["entities"] for s in e["spheres"]]
        drawn = np.array([viewer.place(frame, sphere["pose"]["position"]) for frame, sphere in spheres])
        ends, radius = space.ends(angles[:, sample])
        np.testing.assert_allclose(drawn, ends.reshape(-1, 3) @ upright.T, atol=1e-5)
        np.testing.assert_allclose([s["size"]["x"] for _, s in spheres], np.repeat(2 * radius, 2), atol=1e-6)


def test_cylinders_lie_between_the_ends_of_their_capsules() -> None:
    scene = moving_scene(load_config(Path("wx250s")))
    for entity in scene_message(scene, 0)["entities"]:
        rods = [rod for rod in scene.rods if rod.frame == entity["id"] and np.ptp(rod.ends, axis=0).any()]
        for rod, cylinder in zip(rods, entity["cylinders"], strict=True):
            turn = Rotation.from_quat([cylinder["pose"]["orientation"][axis] for axis in "xyzw"])
            half = turn.apply([0.0, 0.0, 0.5 * cylinder["size"]["z"]])
            middle = np.array([cylinder["pose"]["position"][axis] for axis in "xyz"])
            np.testing.assert_allclose([middle - half, middle + half], rod.ends, atol=1e-5)


def planar_tip(config: Config, angles: np.ndarray) -> np.ndarray:
    lengths = config.arm.link_lengths or (1.0,) * len(angles)
    along = np.cumsum(angles)
    return np.array([np.sum(lengths * np.cos(along)), 0.0, np.sum(lengths * np.sin(along))])


def test_a_recorded_planar_arm_reads_back_as_it_moved(identified: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed: pip install 'hil[export]'")
    config = load_config(identified / "config.toml")
    samples = load_samples(identified / "samples.npy", len(config.joints))
    with export(identified, "mcap").path.open("rb") as file:
        found = list(reader.make_reader(file).iter_messages(["/arm", "/transforms"]))
    names = {channel.topic: schema.name for schema, channel, _ in found}
    assert names == {"/arm": "foxglove.SceneUpdate", "/transforms": "foxglove.FrameTransforms"}
    (shapes,) = [json.loads(message.data) for _, channel, message in found if channel.topic == "/arm"]
    moving = [message for _, channel, message in found if channel.topic == "/transforms"]
    spheres = [(e["frame_id"], s["pose"]["position"]) for e in shapes["entities"] for s in e["spheres"]]
    frame, tip = spheres[-1]
    time = samples["deadline"] - samples["deadline"][0]
    for message in moving[:: max(1, len(moving) // 20)]:
        at = np.argmin(np.abs(time - (message.log_time - moving[0].log_time) * 1e-9 - time[0]))
        drawn = Viewer(json.loads(message.data)).place(frame, tip)
        np.testing.assert_allclose(drawn, planar_tip(config, samples["position"][at]), atol=1e-4)
    seconds = (moving[-1].log_time - moving[0].log_time) * 1e-9
    assert len(moving) / seconds == pytest.approx(50.0, rel=0.05)
