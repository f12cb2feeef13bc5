"""Read serial arms from MJCF files, using MuJoCo's own parser, which also handles defaults, included files and inertias
derived from shapes.
"""

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.description.arm import ArmDescription, ArmFileError, ArmJoint, Array, Body, check_size
from hil.description.motion import rotation_about
from hil.description.urdf import check_units

WORLD = 0
PIVOTS = {0: "free", 1: "ball", 2: "slide", 3: "hinge"}
HINGE = 3
LOOPS = {0: "connect", 1: "weld"}
KINDS = {0: "plane", 2: "sphere", 3: "capsule", 5: "cylinder", 6: "box"}
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2}
COUPLED = 2  # MuJoCo's equality constraint between two joint angles
USUAL_GRAVITY = (0.0, 0.0, -9.81)


def read_mjcf(path: Path, joints: Sequence[str] | None = None) -> ArmDescription:
    """Read the arm formed by these joints, from the base outwards; the default is all hinges. The base is MuJoCo's
    world.

    Raises ArmFileError for the same reasons as `hil.description.urdf.read_urdf`, and if MuJoCo is not installed.
    """
    tree = _Tree(_compiled(path), path)
    names = list(joints) if joints is not None else tree.hinges
    chosen = tree.branch(names)
    arm = []
    held: list[str] = []
    before = WORLD
    for name, body in zip(names, chosen, strict=True):
        joint = int(tree.model.body_jntadr[body])
        rotation, translation = tree.frame(body, before)
        axis = np.array(tree.model.jnt_axis[joint])
        merged, fixed, stiff = tree.rigid(body, set(chosen))
        if not merged.mass > 0.0:
            raise ArmFileError(
                f'{path}: body "{tree.name(body)}", moved by joint "{name}", has no mass: give it an <inertial>'
            )
        held += stiff
        back = rotation @ rotation_about(axis, -float(tree.model.qpos0[tree.model.jnt_qposadr[joint]]))
        arm.append(ArmJoint(name, tree.name(body), back, translation, axis, tree.limits(joint), merged, tuple(fixed)))
        before = body
    check_units(arm, path)
    doubts = tuple(
        f'body "{each.link}": no mass distribution can have this inertia; it is used only as an initial guess'
        for each in arm
        if not each.body.is_physical
    )
    doubts += tuple(tree.not_modelled(names, chosen))
    return ArmDescription(path, "world", tuple(arm), tuple(held), doubts, tree.gravity)


@dataclass(frozen=True)
class Geom:
    """A shape of an MJCF file, in the frame of its moving link.

    link: number of that link; 0 for shapes fixed to the world. kind: "sphere", "capsule", "cylinder", "box" or "mesh".
    size: as in MuJoCo, half the edge lengths of a box, or the radius and, except for a sphere, half the length [m]; for
    a mesh, half the edge lengths of its bounding box. Any other shape is treated as a mesh.
    """

    link: int
    kind: str
    size: tuple[float, ...]
    rotation: Array
    translation: Array


def read_geoms(path: Path, joints: Sequence[str]) -> list[Geom]:
    """Read the shapes of the arm formed by these joints, and those fixed to the world, except planes.

    Shapes without contacts, such as visual ones, are used only for links that have no others. Raises
    ArmFileError.
    """
    tree = _Tree(_compiled(path), path)
    model = tree.model
    number = {body: index for index, body in enumerate(tree.branch(list(joints)), start=1)}
    found: list[tuple[bool, Geom]] = []
    for index in range(model.ngeom):
        kind = KINDS.get(int(model.geom_type[index]), "mesh")
        if kind == "plane":
            continue
        turn, place = _rotation(model.geom_quat[index]), np.array(model.geom_pos[index])
        size = model.geom_size[index][: SIZES.get(kind, 3)]
        if kind == "mesh":
            place = place + turn @ model.geom_aabb[index][:3]
            size = model.geom_aabb[index][3:]
        link, turn, place = tree.on_link(int(model.geom_bodyid[index]), turn, place, number)
        touches = bool(model.geom_contype[index] or model.geom_conaffinity[index])
        found.append((touches, Geom(link, kind, tuple(map(float, size)), turn, place)))
    solid = {geom.link for touches, geom in found if touches}
    return [geom for touches, geom in found if touches or geom.link not in solid]


def _compiled(path: Path) -> Any:
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError as error:
        raise ArmFileError(f"{path}: reading MJCF needs MuJoCo: pip install 'hil[mujoco]', or give a URDF") from error
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ArmFileError(f"{path}: MuJoCo cannot read it: {error}") from error
    check_size(int(model.nbody), path)
    return model


@dataclass(frozen=True)
class _Tree:
    model: Any
    path: Path

    def name(self, body: int) -> str:
        """Name of a body, or its number if it has none."""
        return str(self.model.body(body).name) or f"body {body}"

    @property
    def hinges(self) -> list[str]:
        """Names of all hinge joints in MuJoCo's order, i.e. from the base outwards."""
        return [str(self.model.joint(j).name) for j in range(self.model.njnt) if self.model.jnt_type[j] == HINGE]

    @property
    def gravity(self) -> tuple[float, float, float] | None:
        """Gravity [m/s^2]; None if it is MuJoCo's default."""
        x, y, z = map(float, self.model.opt.gravity)
        return None if (x, y, z) == USUAL_GRAVITY else (x, y, z)

    def not_modelled(self, names: list[str], bodies: list[int]) -> Iterator[str]:
        """Yield one sentence for each kind of force that the file contains but the model (rigid links with friction)
        does not.
        """
        model = self.model
        sprung = [name for name in names if np.any(model.jnt_stiffness[model.joint(name).id])]
        if sprung:
            yield (
                f"{_listed('joint', sprung)} a stiffness, but springs are not modelled: the identified parameters "
                "would absorb the spring's torque. Remove the spring from the arm; if the arm has none, remove it "
                "from the file"
            )
        links = [body for body in range(1, model.nbody) if not {*bodies}.isdisjoint(self._way(body))]
        floating = [self.name(body) for body in links if model.body_gravcomp[body]]
        if floating:
            yield (
                f"{_listed('body', floating)} gravcomp, which is not used: gravity acts on every link of a real arm, "
                "and its torque is identified"
            )
        if any(np.any(model.tendon_stiffness[each]) for each in range(model.ntendon)):
            yield "a tendon has a stiffness, but tendons and springs are not modelled: their forces are ignored"

    def branch(self, names: list[str]) -> list[int]:
        """The bodies that these joints move. Raises ArmFileError unless they lie on one branch, in this order."""
        if not names:
            raise ArmFileError(f"{self.path} has no hinge joint, so it does not describe an arm")
        moved = [self._moved(name) for name in names]
        self._check_equalities(names)
        way = self._way(moved[-1])
        for name, body, before in zip(names, moved, [WORLD, *moved], strict=False):
            if body not in way:
                raise ArmFileError(
                    f'{self.path}: joint "{name}" does not lie between the base and "{names[-1]}": the joints must '
                    "form one branch, from the base outwards"
                )
            between = [other for other in self._way(body) if other not in self._way(before) and other != body]
            loose = [other for other in between if self.model.body_jntnum[other]]
            if before not in (WORLD, *self._way(body)) or loose:
                where = self.name(loose[0]) if loose else name
                raise ArmFileError(
                    f'{self.path}: a joint before "{name}" (at "{where}") is not among the arm\'s joints: name '
                    "all joints, in order from the base"
                )
        return moved

    def _moved(self, name: str) -> int:
        found = [j for j in range(self.model.njnt) if self.model.joint(j).name == name]
        if not found:
            raise ArmFileError(
                f'{self.path} has no joint "{name}"; the rotating joints are {", ".join(self.hinges) or "none"}'
            )
        kind = int(self.model.jnt_type[found[0]])
        if kind != HINGE:
            raise ArmFileError(
                f'{self.path}: joint "{name}" is of type {PIVOTS[kind]}: only hinge joints can be identified'
            )
        body = int(self.model.jnt_bodyid[found[0]])
        if self.model.body_jntnum[body] != 1:
            raise ArmFileError(
                f'{self.path}: body "{self.name(body)}" has several joints: give each joint a body of its own, each '
                "with a small <inertial>"
            )
        return body

    def _check_equalities(self, names: list[str]) -> None:
        for index in range(self.model.neq):
            kind = int(self.model.eq_type[index])
            if kind in LOOPS:
                raise ArmFileError(
                    f"{self.path}: the equality constraint <{LOOPS[kind]}> closes a loop, which a serial arm does not "
                    "have: remove it"
                )
            joint = int(self.model.eq_obj1id[index])
            if kind == COUPLED and self.model.joint(joint).name in names:
                raise ArmFileError(
                    f'{self.path}: joint "{self.model.joint(joint).name}" is coupled to another by an equality '
                    "constraint, so it has no motor of its own: leave it out"
                )

    def _way(self, body: int) -> list[int]:
        """Bodies on the path from this one to the world, excluding the world."""
        way = []
        while body != WORLD:
            way.append(body)
            body = int(self.model.body_parentid[body])
        return way

    def frame(self, body: int, before: int) -> tuple[Array, Array]:
        """Rotation and position of a body's joint in the frame of the previous moving body, whose origin is at the
        previous joint.
        """
        rotation, translation = np.eye(3), np.zeros(3)
        for part in self._way(body):
            if part == before:
                break
            turn, place = self._placed(part)
            rotation, translation = turn @ rotation, turn @ translation + place
        return rotation, translation + rotation @ self._pivot(body) - self._pivot(before)

    def on_link(
        self, body: int, rotation: Array, translation: Array, number: dict[int, int]
    ) -> tuple[int, Array, Array]:
        """Return the number of the moving link to which a body is fixed, and a pose converted from the body's frame to
        that link's frame.
        """
        while body != WORLD and body not in number:
            turn, place = self._placed(body)
            rotation, translation = turn @ rotation, turn @ translation + place
            body = int(self.model.body_parentid[body])
        return number.get(body, 0), rotation, translation - self._pivot(body)

    def rigid(self, body: int, chosen: set[int]) -> tuple[Body, list[str], list[str]]:
        """Merge a body with everything fixed to it, in the frame of its joint. Also returns the names of the merged
        bodies and of held joints.
        """
        merged, fixed, held = self._merged(body, chosen)
        return merged.moved(np.eye(3), -self._pivot(body)), fixed, held

    def _merged(self, body: int, chosen: set[int]) -> tuple[Body, list[str], list[str]]:
        turn = _rotation(self.model.body_iquat[body])
        inertia = turn @ np.diag(self.model.body_inertia[body]) @ turn.T
        merged = Body(float(self.model.body_mass[body]), np.array(self.model.body_ipos[body]), inertia)
        fixed: list[str] = []
        held: list[str] = []
        for child in range(1, self.model.nbody):
            if int(self.model.body_parentid[child]) != body or child in chosen:
                continue
            first = int(self.model.body_jntadr[child])
            held += [str(self.model.joint(first + j).name) for j in range(int(self.model.body_jntnum[child]))]
            part, names, more = self._merged(child, chosen)
            merged = merged.joined(part.moved(*self._placed(child)))
            fixed += [self.name(child), *names]
            held += more
        return merged, fixed, held

    def _placed(self, body: int) -> tuple[Array, Array]:
        return _rotation(self.model.body_quat[body]), np.array(self.model.body_pos[body])

    def _pivot(self, body: int) -> Array:
        """Position of the body's joint, in the body's own frame (3,) [m]."""
        if body == WORLD or not self.model.body_jntnum[body]:
            return np.zeros(3)
        return np.array(self.model.jnt_pos[int(self.model.body_jntadr[body])])

    def limits(self, joint: int) -> tuple[float, float] | None:
        """Limits of a joint [rad]; None if it has none."""
        if not self.model.jnt_limited[joint]:
            return None
        low, high = map(float, self.model.jnt_range[joint])
        return low, high


def _listed(what: str, names: list[str]) -> str:
    plural = {"joint": "joints", "body": "bodies"}[what]
    quoted = ", ".join(f'"{name}"' for name in names)
    return f"{what} {quoted} has" if len(names) == 1 else f"{plural} {quoted} have"


def _rotation(quaternion: Array) -> Array:
    """Rotation matrix of a quaternion w, x, y, z."""
    w, x, y, z = map(float, quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
