"""Capsules that enclose each link: from the collision geometry in the arm's file, otherwise from the joint
positions.

A capsule is the set of points within its radius of a line segment. A mesh is replaced by its bounding box. A link whose
geometry cannot be read is assumed to be a capsule of guessed radius from joint to joint, and is listed in
`Shapes.guessed`.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hil.clearance.mesh import UnreadMesh, mesh_corners
from hil.description.arm import ArmDescription, ArmFileError
from hil.description.files import is_mjcf
from hil.description.mjcf import Geom, read_geoms
from hil.description.urdf import MOST_LENGTH, parse_urdf, rotation_of
from hil.estimator.arrays import Array

Placed = tuple[int, Array, Array, ET.Element | None]

GUESSED_SHARE, GUESSED_LEAST, GUESSED_MOST = 0.2, 0.015, 0.05
"""Radius of a link without geometry: this fraction of its length, clipped to these bounds [m]."""

MOST_STRIPS = 4
LONGEST_PIECE = 0.08  # m
_NOTHING = 1e-6


@dataclass(frozen=True)
class Capsule:
    """A capsule fixed to a link.

    link: 0 for the fixed base, then 1 to the number of joints. ends: end points (2, 3) [m] in that link's frame.
    radius: radius [m].
    """

    link: int
    ends: Array
    radius: float


@dataclass(frozen=True)
class Shapes:
    """The capsules of an arm.

    names: names of the links, the base's first. guessed: links whose shape was guessed from the joint positions.
    doubts: one sentence for each guessed link, except a base without geometry; it explains why the shape is unknown and
    what replaces it.
    """

    names: tuple[str, ...]
    capsules: tuple[Capsule, ...]
    guessed: tuple[str, ...]
    doubts: tuple[str, ...] = ()


def shapes_of(arm: ArmDescription) -> Shapes:
    """Enclose the links of an arm in capsules. Raises ArmFileError."""
    names = (arm.base, *(joint.link for joint in arm.joints))
    placed = _placed(arm)
    geoms = _geoms(arm)
    capsules: list[Capsule] = []
    guessed, doubts = [], []
    for link in range(len(names)):
        here = [each for each in placed if each[0] == link]
        found, unread = _around(here, arm, link)
        found += [Capsule(link, *each) for geom in geoms if geom.link == link for each in _of_geom(geom)]
        if not found or unread:
            guessed.append(names[link])
            instead = _from_joints(arm, link, [shift for _, _, shift, _ in here]) if link > 0 else []
            if unread or link > 0:
                doubts.append(_doubt(names[link], unread, bool(found), instead, link == len(arm.joints)))
            found += instead
        capsules += [piece for each in found for piece in _pieces(each)]
    for each in capsules:
        if not (np.isfinite(each.ends).all() and 0.0 <= each.radius < np.inf):
            raise ArmFileError(
                f'{arm.path}: link "{names[each.link]}": a size or origin in its collision geometry is not a number'
            )
    return Shapes(names, tuple(capsules), tuple(guessed), tuple(doubts))


def _doubt(name: str, unread: list[str], has_others: bool, instead: list[Capsule], is_last: bool) -> str:
    why = "; ".join(unread) if unread else "it has no collision or visual geometry"
    if not instead:
        left = (
            "Only its other shapes are checked: the clearance to the rest"
            if has_others
            else "It has no shape: the clearance to it"
        )
        return f'link "{name}": {why}. {left} is unknown.'
    (capsule,) = instead
    length = float(np.linalg.norm(capsule.ends[1]))
    along = f"capsule {1e3 * length:.0f} mm long from its joint to {'its end' if is_last else 'the next one'}"
    end = ", and the end is estimated from the centre of mass" if is_last else ""
    return (
        f'link "{name}": {why}. A {along if length > _NOTHING else "sphere at its joint"} is used instead'
        f"{', in addition to its other shapes' if has_others else ''}. The radius of {1e3 * capsule.radius:.0f} mm is "
        f"a guess{end}, so the clearance to this link is uncertain."
    )


@dataclass(frozen=True)
class Solid:
    """A primitive of a file's collision geometry, in the frame of its moving link.

    link: 0 for the fixed base. kind: "box", "cylinder", "capsule", "sphere" or "mesh". size: as in MuJoCo, half edge
    lengths, or radius and half length [m]; empty for a mesh. rotation (3, 3), translation (3,) [m]: its pose.
    """

    link: int
    kind: str
    size: tuple[float, ...]
    rotation: Array
    translation: Array


def solids_of(arm: ArmDescription) -> list[Solid]:
    """The primitives of a URDF or MJCF. Raises ArmFileError."""
    found = [
        Solid(each.link, each.kind, () if each.kind == "mesh" else each.size, each.rotation, each.translation)
        for each in _geoms(arm)
    ]
    for link, rotation, translation, element in _placed(arm):
        for shape, turn, shift in () if element is None else _geometry(element):
            place = rotation @ turn, rotation @ shift + translation
            found.append(Solid(link, shape.tag, _size_of(shape), *place))
    return found


def _size_of(shape: ET.Element) -> tuple[float, ...]:
    if shape.tag == "box":
        return tuple(0.5 * edge for edge in _numbers(shape.get("size"), 3))
    if shape.tag == "sphere":
        return (float(shape.get("radius", "nan")),)
    if shape.tag in ("cylinder", "capsule"):
        return float(shape.get("radius", "nan")), 0.5 * float(shape.get("length", "nan"))
    return ()


def _geoms(arm: ArmDescription) -> list[Geom]:
    return read_geoms(arm.path, [joint.name for joint in arm.joints]) if is_mjcf(arm.path) else []


def _of_geom(geom: Geom) -> list[tuple[Array, float]]:
    """Ends (2, 3) in the link's frame and radii of capsules that enclose a shape of an MJCF file."""
    size = geom.size
    if geom.kind == "sphere":
        around = [(np.zeros((2, 3)), size[0])]
    elif geom.kind == "capsule":
        around = [(np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), size[0])]
    elif geom.kind == "cylinder":
        around = [_of_cylinder(size[0], 2.0 * size[1])]
    else:
        around = _of_box(np.zeros(3), 2.0 * np.array(size))
    return [(ends @ geom.rotation.T + geom.translation, radius) for ends, radius in around]


def _pieces(capsule: Capsule) -> list[Capsule]:
    """Split a capsule into short ones. The piece next to a joint may be allowed to touch a link that the other pieces
    must not touch.
    """
    length = float(np.linalg.norm(capsule.ends[1] - capsule.ends[0]))
    if not length < np.inf:
        return [capsule]  # rejected by `shapes_of`
    at = np.linspace(0.0, 1.0, max(2, int(np.ceil(length / LONGEST_PIECE)) + 1))
    points = capsule.ends[0] + at[:, None] * (capsule.ends[1] - capsule.ends[0])
    return [Capsule(capsule.link, np.stack(ends), capsule.radius) for ends in pairwise(points)]


def _around(here: list[Placed], arm: ArmDescription, link: int) -> tuple[list[Capsule], list[str]]:
    """Return capsules around everything fixed to one moving link, and a sentence for each shape that could not
    be used.
    """
    found, unread = [], []
    for _, rotation, translation, element in here:
        if element is None:
            continue
        for shape, turn, shift in _geometry(element):
            try:
                around = _of_shape(shape, arm)
            except UnreadMesh as error:
                unread.append(f'its mesh "{shape.get("filename", "")}" is not used: {error}')
                continue
            if around is None:
                unread.append(f"its <{shape.tag}> is not used: unknown shape")
            for ends, radius in around or []:
                found.append(Capsule(link, (ends @ turn.T + shift) @ rotation.T + translation, radius))
    return found, unread


def _placed(arm: ArmDescription) -> list[Placed]:
    """Return, for each link of a URDF, its frame, its element, and the moving link to which it is fixed; nothing for
    other formats.
    """
    if b"<robot" not in arm.path.read_bytes():
        return []
    root = parse_urdf(arm.path)
    elements = {element.get("name", ""): element for element in root.findall("link")}
    number = {joint.name: index for index, joint in enumerate(arm.joints, start=1)}
    frames = {arm.base: (0, np.eye(3), np.zeros(3))}
    waiting = list(root.findall("joint"))
    while waiting:
        known = [joint for joint in waiting if _end(joint, "parent") in frames]
        if not known:
            break
        for joint in known:
            waiting.remove(joint)
            link, rotation, translation = frames[_end(joint, "parent")]
            turn, shift = _origin(joint)
            frames[_end(joint, "child")] = (
                (number[joint.get("name", "")], np.eye(3), np.zeros(3))
                if joint.get("name") in number
                else (link, rotation @ turn, rotation @ shift + translation)
            )
    return [(*frame, elements.get(name)) for name, frame in frames.items()]


def _geometry(link: ET.Element) -> Iterator[tuple[ET.Element, Array, Array]]:
    """Shapes of a link's collision geometry (visual geometry if it has none) and their frames in the link's frame."""
    for element in link.findall("collision") or link.findall("visual"):
        for shape in element.find("geometry") or ():
            if isinstance(shape.tag, str):
                yield shape, *_origin(element)


def _of_shape(shape: ET.Element, arm: ArmDescription) -> list[tuple[Array, float]] | None:
    """Ends (2, 3) and radii of capsules that enclose a shape; None if its type is unknown. Raises UnreadMesh."""
    if shape.tag == "sphere":
        return [(np.zeros((2, 3)), float(shape.get("radius", "nan")))]
    if shape.tag == "cylinder":
        return [_of_cylinder(float(shape.get("radius", "nan")), float(shape.get("length", "nan")))]
    if shape.tag == "capsule":
        half = 0.5 * float(shape.get("length", "nan"))
        return [(np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(shape.get("radius", "nan")))]
    if shape.tag == "box":
        return _of_box(np.zeros(3), np.array(_numbers(shape.get("size"), 3)))
    if shape.tag == "mesh":
        corners = mesh_corners(shape.get("filename", ""), arm.path)
        corners = corners * np.array(_numbers(shape.get("scale"), 3, 1.0))
        low, high = corners.min(axis=0), corners.max(axis=0)
        if (size := float((high - low).max())) > MOST_LENGTH:
            raise UnreadMesh(
                f'it is {size:.4g} m long; if the file is in millimetres, add scale="0.001 0.001 0.001" to its <mesh>'
            )
        return _of_box(0.5 * (low + high), high - low)
    return None


def _of_cylinder(radius: float, length: float) -> tuple[Array, float]:
    """Enclose a flat cylinder in a sphere, any other in a capsule with the same axis."""
    half = 0.5 * length
    if half < 0.5 * radius:
        return np.zeros((2, 3)), float(np.hypot(radius, half))
    return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), radius


def _of_box(centre: Array, size: Array) -> list[tuple[Array, float]]:
    """Enclose a box in capsules parallel to its longest edge, side by side along the second-longest."""
    third, second, longest = np.argsort(size)
    strips = int(np.clip(np.round(size[second] / max(size[third], _NOTHING)), 1, MOST_STRIPS))
    width = size[second] / strips
    radius = 0.5 * float(np.hypot(width, size[third]))
    along = np.zeros(3)
    along[longest] = 0.5 * size[longest]
    found = []
    for strip in range(strips):
        middle = centre.copy()
        middle[second] += (strip - 0.5 * (strips - 1)) * width
        found.append((np.stack((middle - along, middle + along)), radius))
    return found


def _from_joints(arm: ArmDescription, link: int, fixed: list[Array]) -> list[Capsule]:
    """A capsule from the link's joint to the next one.

    The last link's capsule ends at the farthest frame fixed to the link or at twice the distance of its centre of mass,
    whichever is farther from the joint.
    """
    if link < len(arm.joints):
        end = arm.joints[link].translation
    else:
        beyond = [*fixed, 2.0 * arm.joints[link - 1].body.centre]
        end = max(beyond, key=lambda each: float(np.linalg.norm(each)))
    radius = float(np.clip(GUESSED_SHARE * np.linalg.norm(end), GUESSED_LEAST, GUESSED_MOST))
    return [Capsule(link, np.stack((np.zeros(3), end)), radius)]


def _end(joint: ET.Element, end: str) -> str:
    tag = joint.find(end)
    return "" if tag is None else tag.get("link", "")


def _origin(element: ET.Element) -> tuple[Array, Array]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    return rotation_of(*_numbers(origin.get("rpy"), 3, 0.0)), np.array(_numbers(origin.get("xyz"), 3, 0.0))


def _numbers(text: str | None, count: int, default: float = float("nan")) -> list[float]:
    """Parse `count` numbers. Without text, all are `default`; if the text holds more or fewer numbers, all are NaN."""
    found = [default] * count if text is None else [float(word) for word in text.split()]
    return found if len(found) == count else [float("nan")] * count
