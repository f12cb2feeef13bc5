"""Foxglove's messages for a moving arm, as JSON: `foxglove.FrameTransforms` and `foxglove.SceneUpdate`.

Field names are those of Foxglove's public schemas; the schemas written here list only the fields used.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hil.estimator.arrays import Array
from hil.export.moving_scene import Block, MovingScene, Rod

TRANSFORMS, SCENE = "foxglove.FrameTransforms", "foxglove.SceneUpdate"
_LINK, _OBSTACLE = {"r": 0.0, "g": 0.45, "b": 0.7, "a": 1.0}, {"r": 0.54, "g": 0.56, "b": 0.6, "a": 0.5}
_SHORT = 1e-9  # m
_EMPTY = ("arrows", "lines", "triangles", "texts", "models")


def stamp_of(nanoseconds: int) -> dict[str, int]:
    """Convert a time since 1970 [ns] to a Foxglove time stamp."""
    return {"sec": nanoseconds // 1_000_000_000, "nsec": nanoseconds % 1_000_000_000}


def scene_message(scene: MovingScene, nanoseconds: int) -> dict[str, Any]:
    """All shapes, as one entity per frame; the entities persist and follow their frames."""
    entities = []
    for frame in scene.frames:
        rods = [rod for rod in scene.rods if rod.frame == frame.name]
        entities.append(
            {
                "timestamp": stamp_of(nanoseconds),
                "frame_id": frame.name,
                "id": frame.name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": True,
                "metadata": [],
                "cylinders": [_cylinder(rod) for rod in rods if np.linalg.norm(rod.ends[1] - rod.ends[0]) > _SHORT],
                "spheres": [_sphere(end, rod.radius) for rod in rods for end in rod.ends],
                "cubes": [_cube(block) for block in scene.blocks if block.frame == frame.name],
                **{name: [] for name in _EMPTY},
            }
        )
    return {"deletions": [], "entities": entities}


def transform_messages(scene: MovingScene, angles: Array, nanoseconds: list[int]) -> list[dict[str, Any]]:
    """One message per sample, for angles (joints, samples) [rad]."""
    poses = [(frame, *frame.poses(angles)) for frame in scene.frames]
    return [
        {
            "transforms": [
                {
                    "timestamp": stamp_of(at),
                    "parent_frame_id": frame.parent,
                    "child_frame_id": frame.name,
                    "translation": _vector(shift),
                    "rotation": _quaternion(turns[sample]),
                }
                for frame, shift, turns in poses
            ]
        }
        for sample, at in enumerate(nanoseconds)
    ]


def transforms_schema() -> dict[str, Any]:
    """JSON schema of `foxglove.FrameTransforms`."""
    transform = _object(
        timestamp=_TIME,
        parent_frame_id={"type": "string"},
        child_frame_id={"type": "string"},
        translation=_VECTOR,
        rotation=_QUATERNION,
    )
    return {"title": TRANSFORMS, **_object(transforms=_list(transform))}


def scene_schema() -> dict[str, Any]:
    """JSON schema of `foxglove.SceneUpdate`."""
    pose, colour = _object(position=_VECTOR, orientation=_QUATERNION), _numbers("rgba")
    shape = {"pose": pose, "size": _VECTOR, "color": colour}
    cylinder = _object(**shape, bottom_scale={"type": "number"}, top_scale={"type": "number"})
    entity = _object(
        timestamp=_TIME,
        frame_id={"type": "string"},
        id={"type": "string"},
        lifetime=_TIME,
        frame_locked={"type": "boolean"},
        metadata=_list(_object(key={"type": "string"}, value={"type": "string"})),
        cylinders=_list(cylinder),
        spheres=_list(_object(**shape)),
        cubes=_list(_object(**shape)),
        **{name: _list({"type": "object"}) for name in _EMPTY},
    )
    return {"title": SCENE, **_object(deletions=_list({"type": "object"}), entities=_list(entity))}


def _cylinder(rod: Rod) -> dict[str, Any]:
    along = rod.ends[1] - rod.ends[0]
    length = float(np.linalg.norm(along))
    turn, _ = Rotation.align_vectors(along[None] / length, np.array([[0.0, 0.0, 1.0]]))
    size = np.array([2.0 * rod.radius, 2.0 * rod.radius, length])
    return {**_shape(rod.ends.mean(axis=0), turn.as_quat(), size, _LINK), "bottom_scale": 1.0, "top_scale": 1.0}


def _sphere(centre: Array, radius: float) -> dict[str, Any]:
    return _shape(centre, np.array([0.0, 0.0, 0.0, 1.0]), np.full(3, 2.0 * radius), _LINK)


def _cube(block: Block) -> dict[str, Any]:
    return _shape(block.centre, Rotation.from_matrix(block.rotation).as_quat(), block.size, _OBSTACLE)


def _shape(centre: Array, quaternion: Array, size: Array, colour: dict[str, float]) -> dict[str, Any]:
    pose = {"position": _vector(centre), "orientation": _quaternion(quaternion)}
    return {"pose": pose, "size": _vector(size), "color": colour}


def _vector(values: Array) -> dict[str, float]:
    return dict(zip("xyz", (round(float(value), 7) for value in values), strict=True))


def _quaternion(values: Array) -> dict[str, float]:
    return dict(zip("xyzw", (round(float(value), 7) for value in values), strict=True))


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _numbers(names: str) -> dict[str, Any]:
    return _object(**{name: {"type": "number"} for name in names})


_TIME = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR, _QUATERNION = _numbers("xyz"), _numbers("xyzw")
