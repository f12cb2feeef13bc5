"""An arm's motion as data for the page: geometry once, then angles and, for spatial arms, clearances, frame by frame.

The page's scripts place the links themselves, so that a motion of several minutes takes only a few hundred kilobytes.
"""

from typing import Any

import numpy as np

from hil.clearance.space import Space
from hil.config.schema import Config
from hil.description.urdf import rotation_of
from hil.estimator.arrays import Array, Mask
from hil.report.section import Motion, SpatialMotion

MOST_FRAMES = 600
FEW_POSES = 60
"""Number of poses used to determine the size of the picture."""
MOST_SHOWN_M = 1.0
"""Larger clearances are shown as this value [m]."""


def planar_motion(config: Config, position: Array, rate: float, caption: str) -> Motion:
    """The motion (joints, samples) [rad] of a configured planar arm; links without a length are drawn 1 m long."""
    step = _frame_step(position)
    lengths = config.arm.link_lengths or (1.0,) * len(position)
    return Motion(
        step / rate,
        tuple(tuple(round(float(angle), 4) for angle in row) for row in position[:, ::step]),
        tuple(float(length) for length in lengths),
        bool(config.arm.gravity),
        caption,
    )


def spatial_motion(
    config: Config, position: Array, rate: float, caption: str, ways: tuple[int, int] = (0, 0)
) -> SpatialMotion:
    """The motion (joints, samples) [rad] of a configured spatial arm.

    ways: numbers of samples at the beginning, while the arm leaves the rest pose, and at the end, while it returns to
    it; in those samples, clearances below the margin are allowed. Raises ConfigError, ArmFileError.
    """
    space = Space.of(config)
    step = _frame_step(position)
    kept = np.arange(0, position.shape[1], step)
    angles = position[:, kept]
    on_the_way = (kept < ways[0]) | (kept >= position.shape[1] - ways[1])
    upright = rotation_of(*config.arm.base)
    centre, reach = _extent(space, angles, upright)
    scene: dict[str, Any] = {
        "interval": step / rate,
        "angles": np.round(angles, 4).tolist(),
        "names": [joint.name for joint in config.joints],
        "limits": [[round(float(end), 4) for end in joint.position_limit] for joint in config.joints],
        "chain": [_rounded(turn, shift, axis) for turn, shift, axis in zip(*space.chain, strict=True)],
        "capsules": _capsules(space),
        "boxes": [_rounded(*box) for box in space.boxes],
        "upright": _rounded(upright),
        "floor": space.floor[1] if np.isfinite(space.floor[1]) else None,
        "centre": _rounded(centre),
        "reach": round(reach, 4),
        **_clearances(space, angles, on_the_way),
    }
    return SpatialMotion(caption, scene)


def _frame_step(position: Array) -> int:
    return max(1, -(-int(position.shape[1]) // MOST_FRAMES))


def _clearances(space: Space, angles: Array, on_the_way: Mask) -> dict[str, Any]:
    """For each frame: least clearance [mm], least excess over the required clearance [mm], and index of the pair."""
    pairs: dict[tuple[str, str], int] = {}
    clearance, room, nearest = [], [], []
    for frame, way in enumerate(on_the_way.tolist()):
        found = space.nearest(angles[:, [frame]], on_the_way=way)
        lies = way and bool(space.lies(angles[:, [frame]])[0])
        clearance.append(round(1e3 * min(found.distance, MOST_SHOWN_M)))
        room.append(round(1e3 * min(max(found.room, 0.0) if lies else found.room, MOST_SHOWN_M)))
        nearest.append(pairs.setdefault(found.pair, len(pairs)))
    return {"pairs": list(map(list, pairs)), "clearance": clearance, "room": room, "nearest": nearest}


def _capsules(space: Space) -> list[dict[str, Any]]:
    return [
        {"link": each.link, "name": space.shapes.names[each.link], "ends": _rounded(each.ends), "radius": each.radius}
        for each in space.shapes.capsules
    ]


def _extent(space: Space, angles: Array, upright: Array) -> tuple[Array, float]:
    """Centre and radius [m] of a sphere around the boxes and the arm in all its poses, in the upright frame."""
    every = np.linspace(0, angles.shape[1] - 1, min(FEW_POSES, angles.shape[1])).astype(int)
    ends = np.concatenate([space.ends(angles[:, frame])[0].reshape(-1, 3) for frame in every] + [np.zeros((1, 3))])
    radius = max((each.radius for each in space.shapes.capsules), default=0.0)
    arm, boxes = ends @ upright.T, _corners(space) @ upright.T
    every_point = np.concatenate([arm, boxes])
    centre = 0.5 * (every_point.min(axis=0) + every_point.max(axis=0))
    farthest = float(np.linalg.norm(arm - centre, axis=1).max()) + radius
    return centre, max(farthest, float(np.linalg.norm(boxes - centre, axis=1).max(initial=0.0)))


def _corners(space: Space) -> Array:
    """Corners of all boxes in the base frame (corners, 3) [m]."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    corners = [box[3] + (signs * box[4]) @ box[:3].T for box in space.boxes]
    return np.concatenate(corners) if corners else np.zeros((0, 3))


def _rounded(*arrays: Array) -> list[float]:
    """All numbers in one list, rounded to a hundredth of a millimetre."""
    flat = np.concatenate([np.asarray(each, dtype=np.float64).reshape(-1) for each in arrays])
    return [float(value) for value in np.round(flat, 5)]
