"""Read the branch formed by the arm's joints from a URDF. Everything rigidly attached to a link is merged into it.

Format: wiki.ros.org/urdf/XML. Only geometry and inertias are read; meshes are not opened.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.description.arm import ArmDescription, ArmFileError, ArmJoint, Array, Body, check_size
from hil.description.regular_file import not_a_file
from hil.description.urdf_doubts import (
    angles_in_degrees,
    bulky_links,
    impossible_inertias,
    left_out_mimics,
    without_inertia,
)

MOST_LENGTH = 3.0  # m from joint to joint; a larger value suggests millimetres
MOST_MASS = 100.0  # kg per link; a larger value suggests grams
MOST_GYRATION = 2.0  # m, radius of gyration; a larger value suggests wrong units
TURNING = ("revolute", "continuous")
MOVABLE = (*TURNING, "prismatic", "planar", "floating")
_LENGTHS = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    rotation: Array
    translation: Array
    axis: Array
    limits: tuple[float, float] | None
    mimics: str | None


def read_urdf(path: Path, joints: Sequence[str] | None = None) -> ArmDescription:
    """Read the arm formed by these joints, in order from the base; the default is all rotating joints.

    Raises ArmFileError for anything that is not a URDF of a serial arm: loops; joints that do not exist, do not form
    one branch, are prismatic or mimic others; links without mass; axes that are not unit vectors; units that are not
    SI.
    """
    root = parse_urdf(path)
    bodies, physical = _links(root, path)
    tree = _joints(root, bodies, path)
    base = _root_link(bodies, tree, path)
    names = list(joints) if joints is not None else _all_turning(tree, base, path)
    branch = _branch(tree, base, names, path)
    chosen = {joint.name for joint in branch if joint.name in names}
    arm, held = [], []
    rotation, translation = np.eye(3), np.zeros(3)
    for joint in branch:
        translation = translation + rotation @ joint.translation
        rotation = rotation @ joint.rotation
        if joint.name not in chosen:
            continue
        body, fixed, stiff, movable = _rigid(joint.child, bodies, tree, chosen)
        held += stiff
        if not body.mass > 0.0:
            raise ArmFileError(
                f'{path}: link "{joint.child}", moved by joint "{joint.name}", has no mass: give it an '
                "<inertial> with a rough mass [kg], centre and inertia; they are only a starting point"
            )
        arm.append(
            ArmJoint(
                *(joint.name, joint.child, rotation, translation, joint.axis, joint.limits, body, tuple(fixed)),
                movable=movable,
            )
        )
        rotation, translation = np.eye(3), np.zeros(3)
    check_units(arm, path)
    mimics = {name: joint.mimics for name, joint in tree.items()}
    doubts = (
        *impossible_inertias(arm, physical),
        *without_inertia(root, {link for each in arm for link in (each.link, *each.fixed)}),
        *bulky_links(arm),
        *angles_in_degrees(root),
        *left_out_mimics(mimics, held, chosen),
    )
    return ArmDescription(path, base, tuple(arm), tuple(held), doubts)


def parse_urdf(path: Path) -> ET.Element:
    """Parse the file and return its root element, keeping comments. Raises ArmFileError."""
    if said := not_a_file(path):
        raise ArmFileError(f"{path} cannot be read: {said}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ArmFileError(f"{path} cannot be read: it is not UTF-8 text; save it as UTF-8") from error
    except OSError as error:
        raise ArmFileError(f"{path} cannot be read: {error.strerror or error}") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ArmFileError(f"{path} contains a document type or entities, which a URDF does not need: remove them")
    try:
        root = ET.fromstring(text, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    except ET.ParseError as error:
        raise ArmFileError(f"{path} is not XML: {error}") from error
    if root.tag != "robot":
        raise ArmFileError(f"{path} is not a URDF: its root is <{root.tag}>, not <robot>")
    if "<xacro:" in text:
        raise ArmFileError(
            f"{path} contains xacro macros: expand them into another file first (xacro {path.name} > "
            f"{path.stem}_expanded.urdf), and name that file"
        )
    return root


def _links(root: ET.Element, path: Path) -> tuple[dict[str, Body], dict[str, bool]]:
    bodies: dict[str, Body] = {}
    check_size(len(root.findall("link")), path)
    for element in root.findall("link"):
        name = _name(element, "link", path)
        if name in bodies:
            raise ArmFileError(f'{path}: two links are named "{name}"')
        bodies[name] = _body(element.find("inertial"), f'link "{name}"', path)
        _check_shapes(element, f'link "{name}"', path)
    if not bodies:
        raise ArmFileError(f"{path} has no links")
    return bodies, {name: body.mass == 0.0 or body.is_physical for name, body in bodies.items()}


def _body(element: ET.Element | None, where: str, path: Path) -> Body:
    if element is None:
        return Body.nothing()
    rotation, translation = _origin(element, where, path)
    mass = element.find("mass")
    kilograms = 0.0 if mass is None else _number(mass, "value", where, path)
    if kilograms < 0.0:
        raise ArmFileError(f"{path}: {where}: its mass is {kilograms:g} kg; it cannot be negative")
    inertia = np.zeros((3, 3))
    given = element.find("inertia")
    if given is not None:
        for (row, column), key in zip(
            ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), strict=True
        ):
            inertia[row, column] = inertia[column, row] = _number(given, key, where, path, 0.0)
            if row == column and inertia[row, row] < 0.0:
                raise ArmFileError(f"{path}: {where}: its {key} is {inertia[row, row]:g} kg m^2; it cannot be negative")
    return Body(kilograms, np.zeros(3), inertia).moved(rotation, translation)


def _check_shapes(link: ET.Element, where: str, path: Path) -> None:
    """Raise ArmFileError for an invalid size or origin in a link's collision geometry (or visual, if it has none)."""
    for element in link.findall("collision") or link.findall("visual"):
        _origin(element, where, path)
        for shape in element.find("geometry") or ():
            if shape.tag == "mesh":
                _three(shape, "scale", where, path)
            for key in _LENGTHS.get(shape.tag, ()):
                if shape.get(key) is None:
                    raise ArmFileError(f"{path}: {where}: a {shape.tag} in its geometry has no {key}")
                lengths = _three(shape, key, where, path) if key == "size" else [_number(shape, key, where, path)]
                if min(lengths) < 0.0:
                    raise ArmFileError(
                        f'{path}: {where}: a {shape.tag} in its geometry has {key}="{shape.get(key)}", but lengths '
                        "[m] cannot be negative"
                    )


def _joints(root: ET.Element, bodies: dict[str, Body], path: Path) -> dict[str, _Joint]:
    tree: dict[str, _Joint] = {}
    moved: dict[str, str] = {}
    for element in root.findall("joint"):
        name = _name(element, "joint", path)
        where = f'joint "{name}"'
        if name in tree:
            raise ArmFileError(f'{path}: two joints are named "{name}"')
        ends = {}
        for end in ("parent", "child"):
            tag = element.find(end)
            link = None if tag is None else tag.get("link")
            if link not in bodies:
                raise ArmFileError(f"{path}: {where}: its {end} link {link!r} is not in the file")
            ends[end] = str(link)
        if ends["parent"] == ends["child"]:
            raise ArmFileError(f'{path}: {where}: link "{ends["child"]}" is both its parent and its child')
        if ends["child"] in moved:
            raise ArmFileError(
                f'{path}: link "{ends["child"]}" is the child of both "{moved[ends["child"]]}" and "{name}": the links '
                "form a loop, which a serial arm does not have; leave one of the joints out"
            )
        moved[ends["child"]] = name
        kind = element.get("type", "")
        if kind not in (*MOVABLE, "fixed"):
            raise ArmFileError(f"{path}: {where} has type {kind!r}, not revolute, continuous, prismatic or fixed")
        rotation, translation = _origin(element, where, path)
        mimic = element.find("mimic")
        tree[name] = _Joint(
            name,
            kind,
            ends["parent"],
            ends["child"],
            rotation,
            translation,
            _axis(element, where, path) if kind in TURNING else np.array([1.0, 0.0, 0.0]),
            _limits(element, kind, where, path),
            None if mimic is None else str(mimic.get("joint")),
        )
    return tree


def _root_link(bodies: dict[str, Body], tree: dict[str, _Joint], path: Path) -> str:
    children = {joint.child for joint in tree.values()}
    roots = [name for name in bodies if name not in children]
    if not roots:
        raise ArmFileError(f"{path}: every link is a joint's child, so they form a loop; one link must be the base")
    if len(roots) > 1:
        raise ArmFileError(
            f"{path}: links {', '.join(roots)} have no parent joint: only one base link is allowed; attach the others "
            "with fixed joints"
        )
    return roots[0]


def _all_turning(tree: dict[str, _Joint], base: str, path: Path) -> list[str]:
    """Names of the rotating joints. Raises ArmFileError if they do not form a single branch."""
    names: list[str] = []
    link = base
    while True:
        following = [joint for joint in tree.values() if joint.parent == link]
        turning = [joint for joint in following if joint.mimics is None and _turns(joint, tree)]
        if not turning:
            return names
        if len(turning) > 1:
            raise ArmFileError(
                f'{path}: at link "{link}" the arm branches into {", ".join(joint.name for joint in turning)}: name '
                "the arm's joints, in order from the base"
            )
        if turning[0].kind in TURNING:
            names.append(turning[0].name)
        link = turning[0].child


def _turns(joint: _Joint, tree: dict[str, _Joint]) -> bool:
    """Whether this joint or any joint farther from the base rotates."""
    if joint.kind in TURNING:
        return True
    return any(_turns(other, tree) for other in tree.values() if other.parent == joint.child and other.mimics is None)


def _branch(tree: dict[str, _Joint], base: str, names: list[str], path: Path) -> list[_Joint]:
    """All joints from the base to the last of `names`, which must be on this branch in the given order."""
    if not names:
        raise ArmFileError(f"{path}: no joint rotates, so it does not describe an arm")
    if len(set(names)) < len(names):
        raise ArmFileError(f"{path}: in the list of joints ({', '.join(names)}), one is named twice")
    for name in names:
        if name not in tree:
            turning = [joint.name for joint in tree.values() if joint.kind in TURNING]
            raise ArmFileError(f'{path} has no joint "{name}"; the rotating joints are {", ".join(turning) or "none"}')
        joint = tree[name]
        if joint.kind not in TURNING:
            raise ArmFileError(
                f'{path}: joint "{name}" is of type {joint.kind}: only rotating joints (revolute, '
                "continuous) can be identified"
            )
        if joint.mimics is not None:
            raise ArmFileError(
                f'{path}: joint "{name}" mimics "{joint.mimics}", so it has no motor of its own: leave it out. The '
                "model then assumes that its link does not move relative to the one that carries it"
            )
    branch = max((_way_to(tree, base, name, path) for name in names), key=len)
    found = [joint.name for joint in branch if joint.name in names]
    if found != names:
        missing = [name for name in names if name not in found]
        if missing:
            raise ArmFileError(
                f'{path}: joint "{missing[0]}" does not lie between the base and "{branch[-1].name}": the joints '
                "must form one branch"
            )
        raise ArmFileError(f"{path}: from the base, the joints are {', '.join(found)}: list them in this order")
    between = [joint for joint in branch if joint.name not in names and joint.kind != "fixed"]
    if between:
        add = "add it, or make it fixed if it never moves"
        if between[0].kind not in TURNING:
            add = "make it fixed if it never moves; otherwise, this arm cannot be identified"
        raise ArmFileError(
            f'{path}: joint "{between[0].name}" ({between[0].kind}) lies before "{names[-1]}" and is not among the '
            f"arm's joints: {add}"
        )
    return branch


def _way_to(tree: dict[str, _Joint], base: str, name: str, path: Path) -> list[_Joint]:
    """All joints from the base to the one with this name."""
    parent_joint = {joint.child: joint for joint in tree.values()}
    way = [tree[name]]
    while way[0].parent != base:
        way.insert(0, parent_joint[way[0].parent])
        if len(way) > len(tree):
            raise ArmFileError(f'{path}: joint "{name}" is not connected to the base: the links form a loop')
    return way


def _rigid(
    link: str, bodies: dict[str, Body], tree: dict[str, _Joint], chosen: set[str]
) -> tuple[Body, list[str], list[str], dict[str, Body]]:
    """Merge a link with everything attached to it.

    Also returns the names of merged links and of held joints, and the individual bodies of links that held joints move.
    """
    body, fixed, held = bodies[link], [], []
    movable: dict[str, Body] = {}
    for joint in tree.values():
        if joint.parent != link or joint.name in chosen:
            continue
        part, names, more, within = _rigid(joint.child, bodies, tree, chosen)
        if joint.kind != "fixed":
            held.append(joint.name)
            within = dict(_own(joint.child, bodies, tree, chosen))
        body = body.joined(part.moved(joint.rotation, joint.translation))
        fixed += [joint.child, *names]
        held += more
        movable |= {name: each.moved(joint.rotation, joint.translation) for name, each in within.items()}
    return body, fixed, held, movable


def _own(link: str, bodies: dict[str, Body], tree: dict[str, _Joint], chosen: set[str]) -> Iterator[tuple[str, Body]]:
    """Yield a link and all links attached to it by any joint, each with its own body in the frame of the first link."""
    yield link, bodies[link]
    for joint in tree.values():
        if joint.parent == link and joint.name not in chosen:
            for name, body in _own(joint.child, bodies, tree, chosen):
                yield name, body.moved(joint.rotation, joint.translation)


def check_units(arm: Sequence[ArmJoint], path: Path) -> None:
    """Raise ArmFileError if lengths, masses or inertias seem to be in millimetres or grams."""
    for joint in arm:
        length = float(np.linalg.norm(joint.translation))
        if length > MOST_LENGTH:
            raise ArmFileError(
                f'{path}: joint "{joint.name}" is {length:.4g} m from the previous one: is that in millimetres? URDF '
                "uses metres and kilograms"
            )
        body = joint.body
        gyration = math.sqrt(max(float(np.trace(body.inertia)), 0.0) / body.mass)
        if body.mass > MOST_MASS or gyration > MOST_GYRATION or np.linalg.norm(body.centre) > MOST_LENGTH:
            raise ArmFileError(
                f'{path}: link "{joint.link}" has a mass of {body.mass:.4g} kg at {np.linalg.norm(body.centre):.4g} m '
                f"from its joint, and a radius of gyration of {gyration:.4g} m: are these values in g or mm? "
                "URDF uses metres, kilograms and kg m^2"
            )


def _name(element: ET.Element, what: str, path: Path) -> str:
    name = element.get("name")
    if not name:
        raise ArmFileError(f"{path}: a {what} has no name")
    return name


def _limits(element: ET.Element, kind: str, where: str, path: Path) -> tuple[float, float] | None:
    limit = element.find("limit")
    if kind != "revolute" or limit is None or limit.get("lower") is None or limit.get("upper") is None:
        return None
    return _number(limit, "lower", where, path), _number(limit, "upper", where, path)


def _axis(element: ET.Element, where: str, path: Path) -> Array:
    given = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if given is None else _three(given, "xyz", where, path)
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) > 1e-3:
        raise ArmFileError(f"{path}: {where}: its axis {axis.tolist()} has length {length:.4g}, not 1: normalise it")
    unit: Array = axis / length
    return unit


def _origin(element: ET.Element, where: str, path: Path) -> tuple[Array, Array]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    roll, pitch, yaw = _three(origin, "rpy", where, path)
    return rotation_of(roll, pitch, yaw), _three(origin, "xyz", where, path)


def rotation_of(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation matrix (3, 3) for rotations [rad] about the fixed x, then y, then z axis."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _three(element: ET.Element, key: str, where: str, path: Path) -> Array:
    text = element.get(key, "0 0 0")
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ArmFileError(f'{path}: {where}: {key}="{text}" must be three numbers')
    return numbers


def _number(element: ET.Element, key: str, where: str, path: Path, default: float | None = None) -> float:
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ArmFileError(f"{path}: {where}: {key}={text!r} must be a number")
    return number
