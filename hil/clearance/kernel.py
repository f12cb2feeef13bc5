"""Compiled functions: capsule positions along a motion, and the smallest distance among pairs that must not touch.

Distances between segments follow Ericson, Real-Time Collision Detection (2005), 5.1.9. The distance to a box is convex
along a segment, so a golden-section search finds its minimum.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.estimator.chain.model.kernels import place
from hil.estimator.compiled import compiled, embedded

BASE = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
"""Frame of the base: rotation matrix row by row, then origin."""

FLOOR, BOXES = -1, -2
"""Second member of a pair, if it is not the index of another capsule: FLOOR, or `BOXES - index` for a box."""

_SEARCHES = 40
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_SHORT = 1e-18


def _segments(a: Any, b: Any) -> float:
    """Distance between two segments, each (2, 3)."""
    d0, d1, d2 = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1], a[1, 2] - a[0, 2]
    e0, e1, e2 = b[1, 0] - b[0, 0], b[1, 1] - b[0, 1], b[1, 2] - b[0, 2]
    r0, r1, r2 = a[0, 0] - b[0, 0], a[0, 1] - b[0, 1], a[0, 2] - b[0, 2]
    dd, ee = d0 * d0 + d1 * d1 + d2 * d2, e0 * e0 + e1 * e1 + e2 * e2
    f = e0 * r0 + e1 * r1 + e2 * r2
    c = d0 * r0 + d1 * r1 + d2 * r2
    s = t = 0.0
    if dd > _SHORT and ee > _SHORT:
        de = d0 * e0 + d1 * e1 + d2 * e2
        across = dd * ee - de * de
        if across > 1e-12 * dd * ee:
            s = min(max((de * f - c * ee) / across, 0.0), 1.0)
        t = (de * s + f) / ee
        if t < 0.0:
            t, s = 0.0, min(max(-c / dd, 0.0), 1.0)
        elif t > 1.0:
            t, s = 1.0, min(max((de - c) / dd, 0.0), 1.0)
    elif dd > _SHORT:
        s = min(max(-c / dd, 0.0), 1.0)
    elif ee > _SHORT:
        t = min(max(f / ee, 0.0), 1.0)
    x, y, z = r0 + s * d0 - t * e0, r1 + s * d1 - t * e1, r2 + s * d2 - t * e2
    return math.sqrt(x * x + y * y + z * z)


def _to_box(a: Any, s: float, box: Any) -> float:
    """Signed distance from the point at fraction `s` of a segment to a box; negative inside.

    box (5, 3): rotation matrix, centre, half-size.
    """
    out, most = 0.0, -1e300
    for axis in range(3):
        along = 0.0
        for k in range(3):
            along += box[k, axis] * (a[0, k] + s * (a[1, k] - a[0, k]) - box[3, k])
        beyond = abs(along) - box[4, axis]
        most = max(most, beyond)
        if beyond > 0.0:
            out += beyond * beyond
    return math.sqrt(out) if out > 0.0 else most


def _box(a: Any, box: Any) -> float:
    low, high = 0.0, 1.0
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    near_left, near_right = _to_box(a, left, box), _to_box(a, right, box)
    for _ in range(_SEARCHES):
        if near_left < near_right:
            high, right, near_right = right, left, near_left
            left = high - _GOLDEN * (high - low)
            near_left = _to_box(a, left, box)
        else:
            low, left, near_left = left, right, near_right
            right = low + _GOLDEN * (high - low)
            near_right = _to_box(a, right, box)
    return min(near_left, near_right)


def _at(frame: Any, link: Any, ends: Any, out: Any) -> None:
    """Fill `out` (capsules, 2, 3) with the ends of all capsules in the base frame."""
    for k in range(link.size):
        f = frame[link[k]]
        for end in range(2):
            p = ends[k, end]
            for r in range(3):
                out[k, end, r] = f[9 + r] + f[3 * r] * p[0] + f[3 * r + 1] * p[1] + f[3 * r + 2] * p[2]


def _distance(first: int, second: int, at: Any, radius: Any, floor: Any, boxes: Any) -> float:
    """Distance between the members of a pair [m]; negative if they overlap."""
    a = at[first]
    if second >= 0:
        return float(_segments(a, at[second]) - radius[first] - radius[second])
    if second == FLOOR:
        low = min(
            floor[0] * a[0, 0] + floor[1] * a[0, 1] + floor[2] * a[0, 2],
            floor[0] * a[1, 0] + floor[1] * a[1, 1] + floor[2] * a[1, 2],
        )
        return float(low - floor[3] - radius[first])
    return float(_box(a, boxes[BOXES - second]) - radius[first])


def _all_loop(chain: Any, shapes: Any, pairs: Any, q: Any, out: Any) -> None:
    """Fill `out` (samples, pairs) with the distances of all pairs at poses q (samples, joints)."""
    rotation, translation, axis = chain
    link, ends, radius, floor, boxes = shapes
    frame, at = np.empty((q.shape[1] + 1, 12)), np.empty(ends.shape)
    for r in range(BASE.size):  # assigning the row takes 2 s to compile
        frame[0, r] = BASE[r]
    motion = np.empty((q.shape[1], 6, 6))
    for k in range(q.shape[0]):
        place(rotation, translation, axis, q[k], frame[1:], motion)
        _at(frame, link, ends, at)
        for p in range(pairs.shape[0]):
            out[k, p] = _distance(pairs[p, 0], pairs[p, 1], at, radius, floor, boxes)


def _least_loop(chain: Any, shapes: Any, pairs: Any, needed: Any, q: Any, room: Any, worst: Any) -> None:
    """For each pose, find the smallest difference between a pair's distance and its required distance.

    Fill `room` (samples,) with that difference [m] and `worst` (samples,) with the index of the pair.
    """
    rotation, translation, axis = chain
    link, ends, radius, floor, boxes = shapes
    frame, at = np.empty((q.shape[1] + 1, 12)), np.empty(ends.shape)
    for r in range(BASE.size):  # assigning the row takes 2 s to compile
        frame[0, r] = BASE[r]
    motion = np.empty((q.shape[1], 6, 6))
    middle, half = np.empty((link.size, 3)), np.empty(link.size)
    for k in range(link.size):
        length = 0.0
        for r in range(3):
            length += (ends[k, 1, r] - ends[k, 0, r]) ** 2
        half[k] = 0.5 * math.sqrt(length) + radius[k]
    for k in range(q.shape[0]):
        place(rotation, translation, axis, q[k], frame[1:], motion)
        _at(frame, link, ends, at)
        for c in range(link.size):
            for r in range(3):
                middle[c, r] = 0.5 * (at[c, 0, r] + at[c, 1, r])
        room[k], worst[k] = 1e300, -1
        for p in range(pairs.shape[0]):
            a, b = pairs[p, 0], pairs[p, 1]
            if b >= 0:
                # The distance between bounding spheres is a lower bound, which usually suffices to discard the pair.
                apart = (
                    (middle[a, 0] - middle[b, 0]) ** 2
                    + (middle[a, 1] - middle[b, 1]) ** 2
                    + (middle[a, 2] - middle[b, 2]) ** 2
                )
                reach = room[k] + needed[p] + half[a] + half[b]
                if reach > 0.0 and apart > reach * reach:
                    continue
            left = _distance(a, b, at, radius, floor, boxes) - needed[p]
            if left < room[k]:
                room[k], worst[k] = left, p


_segments, _to_box, _box, _at, _distance = map(embedded, (_segments, _to_box, _box, _at, _distance))
all_distances: Callable[..., None] = compiled(_all_loop)
least_room: Callable[..., None] = compiled(_least_loop)
