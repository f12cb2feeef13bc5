"""A spatial arm and what it must not touch: itself, the floor, and the boxes given in `[clearance]`."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.clearance.kept import known_shapes
from hil.clearance.kernel import BOXES, FLOOR, all_distances, least_room
from hil.clearance.shapes import Shapes
from hil.config.chain import described_arm
from hil.config.schema import Config
from hil.description.arm import ArmDescription
from hil.description.motion import rotation_about
from hil.description.urdf import rotation_of
from hil.estimator.arrays import Array, Mask

ALWAYS_SHARE = 0.9
"""Two capsules that are closer than the margin in at least this fraction of random poses are assumed to touch by
design.
"""

NEAR_SHARE, NEAR_SHARE_OF_OTHERS = 0.75, 0.98
"""Two capsules that are closer than BUILT_NEAR in at least this fraction of random poses are near each other by design:
they must not touch, but need no margin. The first value applies if exactly one link lies between them, the second if
more do.
"""

BUILT_NEAR = 0.02  # m beyond the margin
TOUCHED = 0.02
"""Capsules that are closer than this in the rest pose [m] might support the arm there."""

RANDOM_POSES = 400
AT_REST_SLACK = 0.008
"""If the members of a pair are closer than the margin in the rest pose, they may come closer still, by up to this
distance [m], on the way to or from that pose.
"""

AT_REST_INSIDE = 0.02
"""Largest accepted overlap in the rest pose [m]: capsules are larger than the parts they enclose."""

LYING_RAD = 0.12
"""An arm within this angle of its rest pose in every joint counts as at rest; the user has declared that pose safe."""


@dataclass(frozen=True)
class Nearest:
    """The sample of a motion with the least clearance.

    distance: between the members of `pair` [m]. needed: required distance [m]. sample: index of the sample.
    """

    distance: float
    needed: float
    pair: tuple[str, str]
    sample: int

    @property
    def room(self) -> float:
        """Distance minus required distance [m]; negative if too close."""
        return self.distance - self.needed

    @property
    def is_limited(self) -> bool:
        """Whether there is any pair to be checked."""
        return bool(np.isfinite(self.distance))

    def __str__(self) -> str:
        if not self.is_limited:
            return "no parts that could collide"
        return f"{self.pair[0]} and {self.pair[1]}: {1e3 * self.distance:.0f} mm"


@dataclass(frozen=True)
class Space:
    """Pairs of capsules that must stay apart, and by how much.

    as_built: pairs of links that are not fully checked, because some of their capsules are closer than the margin in
    nearly every pose. near: pairs of links with capsules that are near each other in most poses; these must not touch,
    but need no margin.
    """

    shapes: Shapes
    obstacles: tuple[str, ...]
    margin: float
    as_built: tuple[tuple[str, str], ...]
    near: tuple[tuple[str, str], ...]
    rest: Array
    """The rest pose (joints,) [rad]."""
    at_rest: Array
    """Distance of each pair in the rest pose (pairs,) [m]."""
    is_touched: Mask
    """Whether, in the rest pose, anything might touch the part of the arm that each joint moves (joints,)."""
    _built: Array
    """Median distance of pairs that are near each other by design (pairs,) [m]; infinite for other pairs."""
    _pairs: NDArray[np.int64]
    _chain: tuple[Array, Array, Array]
    _arrays: tuple[NDArray[np.int64], Array, Array, Array, Array]

    @classmethod
    def of(cls, config: Config) -> "Space":
        """Build the space of a configured arm. Raises ArmFileError."""
        arm = described_arm(config)
        return _space(_Key(config, arm))

    def room(self, position: Array, on_the_way: bool = False) -> Array:
        """Smallest distance minus required distance in each sample (samples,) [m] of a motion (joints, samples) [rad].

        on_the_way: whether the motion leads from or to the rest pose; distances less than the margin are then allowed.
        """
        return self._least(position, self._needed(on_the_way), on_the_way)[0]

    def has_reserve(self, position: Array, reserve: float) -> bool:
        """Whether a motion (joints, samples) [rad] keeps `reserve` [m] beyond the required distance.

        For pairs near each other by design, half of their median distance is enough.
        """
        needed = self._needed(False)
        needed = np.minimum(needed + reserve, np.maximum(needed, 0.5 * self._built))
        return bool(self._least(position, needed, False)[0].min() >= 0.0)

    def lies(self, position: Array) -> Mask:
        """Whether each pose (samples,) of a motion (joints, samples) [rad] is within LYING_RAD of the rest pose."""
        near: Mask = np.abs(position.T - self.rest).max(axis=1) < LYING_RAD
        return near

    def nearest(self, position: Array, on_the_way: bool = False) -> Nearest:
        """Find the sample of a motion (joints, samples) [rad] with the least clearance."""
        required = self._needed(on_the_way)
        room, worst = self._least(position, required, on_the_way)
        sample = int(np.argmin(room))
        if worst[sample] < 0:
            return Nearest(np.inf, 0.0, ("nothing", "nothing"), sample)
        needed = float(required[worst[sample]])
        return Nearest(float(room[sample]) + needed, needed, self.names_of(int(worst[sample])), sample)

    def wrong_rest_pose(self) -> str:
        """Describe the largest overlap in the rest pose; "" if the excess size of the capsules could explain it."""
        found = self.nearest(self.rest[:, None])
        if found.distance >= -AT_REST_INSIDE:
            return ""
        first, second = found.pair
        return (
            f"arm.rest_pose puts {first} {-1e3 * found.distance:.0f} mm into {second}: the pose, zero_ticks, a "
            "direction, [clearance] or the URDF's collision geometry is wrong. `hil pose` shows the pose as read from "
            "the bus. Add pairs that touch by design to clearance.ignore"
        )

    def ends(self, position: Array) -> tuple[Array, Array]:
        """Ends of all capsules in the base frame (capsules, 2, 3) and their radii [m] at a pose (joints,) [rad]."""
        rotation, translation, axis = self._chain
        frames = [(np.eye(3), np.zeros(3))]
        for turn, shift, around, angle in zip(rotation, translation, axis, position, strict=True):
            former, origin = frames[-1]
            frames.append((former @ turn @ rotation_about(around, float(angle)), origin + former @ shift))
        link, ends, radius, _, _ = self._arrays
        placed = [each @ frames[at][0].T + frames[at][1] for at, each in zip(link, ends, strict=True)]
        return np.array(placed).reshape(-1, 2, 3), radius

    @property
    def floor(self) -> tuple[Array, float]:
        """The floor's normal in the base frame (3,) and its height [m], -inf if there is no floor."""
        return self._arrays[3][:3], float(self._arrays[3][3])

    @property
    def chain(self) -> tuple[Array, Array, Array]:
        """Each joint's rotation (joints, 3, 3), translation [m] and axis (joints, 3) in the previous frame."""
        return self._chain

    @property
    def boxes(self) -> Array:
        """Obstacles in the base frame (boxes, 5, 3): rotation matrix, centre and half of the size [m]."""
        found: Array = self._arrays[4][: len(self.obstacles)]
        return found

    @property
    def links(self) -> NDArray[np.int64]:
        """Index of the link each capsule belongs to (capsules,); 0 is the base."""
        return self._arrays[0]

    def names_of(self, pair: int) -> tuple[str, str]:
        link = self._arrays[0]
        first, second = self._pairs[pair]
        return self.shapes.names[link[first]], self._partner(int(second))

    def _partner(self, second: int) -> str:
        if second >= 0:
            return str(self.shapes.names[self._arrays[0][second]])
        return "floor" if second == FLOOR else self.obstacles[BOXES - second]

    def _needed(self, on_the_way: bool) -> Array:
        full = np.where(np.isfinite(self._built), 0.0, self.margin)
        return np.minimum(full, self.at_rest - AT_REST_SLACK) if on_the_way else full

    def _least(self, position: Array, needed: Array, on_the_way: bool) -> tuple[Array, NDArray[np.int64]]:
        q = np.ascontiguousarray(position.T, dtype=np.float64)
        room, worst = np.empty(len(q)), np.empty(len(q), dtype=np.int64)
        least_room(self._chain, self._arrays, self._pairs, needed, q, room, worst)
        if on_the_way:
            lies = self.lies(position)
            room[lies] = np.maximum(room[lies], 0.0)
        return room, worst


class _Key:
    """Cache key: equal for configurations with the same description, clearance, base, rest pose and limits."""

    def __init__(self, config: Config, arm: ArmDescription) -> None:
        self.config, self.arm = config, arm
        limits = tuple(tuple(joint.position_limit) for joint in config.joints)
        self._said = repr((config.clearance, config.arm.base, config.arm.rest_pose, limits)), id(arm)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._said == other._said

    def __hash__(self) -> int:
        return hash(self._said)


@lru_cache(maxsize=8)
def _space(key: _Key) -> Space:
    config, arm, wanted = key.config, key.arm, key.config.clearance
    shapes = known_shapes(arm)
    link = np.array([capsule.link for capsule in shapes.capsules], dtype=np.int64)
    upright = rotation_of(*config.arm.base)
    floor = np.array([*upright[2], wanted.floor if isinstance(wanted.floor, float) else -np.inf])
    boxes = np.zeros((max(1, len(wanted.boxes)), 5, 3))
    for row, box in zip(boxes, wanted.boxes, strict=False):
        row[:3] = upright.T @ rotation_of(*box.turned)
        row[3], row[4] = upright.T @ np.array(box.centre), 0.5 * np.array(box.size)
    chain = tuple(np.ascontiguousarray(each) for each in arm.geometry)
    arrays = (
        link,
        np.array([capsule.ends for capsule in shapes.capsules]).reshape(-1, 2, 3),
        np.array([capsule.radius for capsule in shapes.capsules]),
        floor,
        boxes,
    )
    obstacles = tuple(box.name for box in wanted.boxes)
    ignored = {frozenset(pair) for pair in wanted.ignore}
    pairs = np.array(_pairs(shapes, link, len(obstacles), np.isfinite(floor[3])), dtype=np.int64).reshape(-1, 2)
    rest = np.array(config.arm.rest_pose)
    at_rest = np.empty((1, len(pairs)))
    all_distances(chain, arrays, pairs, rest[None], at_rest)
    none = np.zeros(len(rest), dtype=bool)
    touching, built = _by_design(config, chain, arrays, pairs, wanted.margin)
    space = Space(*(shapes, obstacles, wanted.margin, (), (), rest, at_rest[0], none, built, pairs), chain, arrays)  # type: ignore[arg-type]
    kept = np.array([frozenset(space.names_of(pair)) not in ignored for pair in range(len(pairs))], dtype=bool)
    left = kept & ~touching
    as_built, near = (
        tuple(sorted({space.names_of(int(pair)) for pair in np.flatnonzero(some)}))
        for some in (touching & kept, np.isfinite(built) & left)
    )
    is_touched = _touched(len(rest), link, pairs[~touching & (at_rest[0] < TOUCHED)])
    return Space(
        *(shapes, obstacles, wanted.margin, as_built, near, rest, at_rest[0, left], is_touched, built[left]),
        *(pairs[left], chain, arrays),  # type: ignore[arg-type]
    )


def _pairs(shapes: Shapes, link: NDArray[np.int64], boxes: int, has_floor: bool) -> list[tuple[int, int]]:
    """Pairs to check: two capsules of non-adjacent links, a capsule and a box, or a capsule and the floor.

    The base and the first link, which is mounted on it, are not checked against the floor.
    """
    count = len(shapes.capsules)
    found = [(a, b) for a in range(count) for b in range(a + 1, count) if abs(link[a] - link[b]) > 1]
    found += [(a, FLOOR) for a in range(count) if link[a] > 1 and has_floor]
    return found + [(a, BOXES - box) for a in range(count) if link[a] > 0 for box in range(boxes)]


def _by_design(
    config: Config, chain: object, arrays: tuple[Any, ...], pairs: NDArray[np.int64], margin: float
) -> tuple[Mask, Array]:
    """Whether the capsules of each pair (pairs,) are closer than the margin in nearly every pose within the limits.

    Also returns the median distance of each pair (pairs,) [m] if its members are near each other in most poses;
    infinite for other pairs.
    """
    link = arrays[0]
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    poses = np.random.default_rng(1).uniform(low, high, (RANDOM_POSES, len(low)))
    distance = np.empty((RANDOM_POSES, len(pairs)))
    all_distances(chain, arrays, pairs, poses, distance)
    are_links = pairs[:, 1] >= 0
    touching: Mask = are_links & ((distance < margin).mean(axis=0) >= ALWAYS_SHARE)
    apart = np.abs(link[pairs[:, 0]] - link[np.maximum(pairs[:, 1], 0)])
    share = np.where(apart == 2, NEAR_SHARE, NEAR_SHARE_OF_OTHERS)
    is_near = are_links & ((distance < margin + BUILT_NEAR).mean(axis=0) >= share)
    median = np.maximum(np.median(distance, axis=0), 0.0)
    return touching, np.where(is_near, median, np.inf)


def _touched(joints: int, link: NDArray[np.int64], contacts: NDArray[np.int64]) -> Mask:
    """For each joint (joints,): whether any contact (contacts, 2) is between a part that it moves and a part that it
    does not move.
    """
    touched = np.zeros(joints, dtype=bool)
    for first, second in contacts:
        ends = sorted((int(link[first]), int(link[second]) if second >= 0 else 0))
        touched[ends[0] : ends[1]] = True
    return touched
