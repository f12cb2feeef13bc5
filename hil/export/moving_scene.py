"""An arm as frames and shapes: where each link is at each sample, and what to draw there.

The MCAP export writes both as `FrameTransforms` and `SceneUpdate` messages, which Foxglove's 3D panel shows.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hil.clearance.space import Space
from hil.config.chain import described_arm
from hil.config.schema import Config
from hil.description.urdf import rotation_of
from hil.estimator.arrays import Array

WORLD, BASE = "world", "base"
PLANAR_RADIUS = 0.1
"""Radius of a planar arm's links as a fraction of their length."""


@dataclass(frozen=True)
class Frame:
    """The frame of a link, which turns about its joint's `axis` (3,).

    rotation, translation: pose of the frame in `parent` at angle zero (3, 3), (3,) [m]. joint: index of the angle; None
    for the base, which is fixed.
    """

    name: str
    parent: str
    rotation: Array
    translation: Array
    axis: Array
    joint: int | None

    def poses(self, angles: Array) -> tuple[Array, Array]:
        """Translation (3,) [m] and quaternions x, y, z, w (samples, 4) for angles (joints, samples) [rad]."""
        fixed = Rotation.from_matrix(self.rotation)
        turned = np.zeros(angles.shape[1]) if self.joint is None else angles[self.joint]
        return self.translation, (fixed * Rotation.from_rotvec(turned[:, None] * self.axis)).as_quat()


@dataclass(frozen=True)
class Rod:
    """A capsule in a frame. ends: (2, 3) [m]; radius: [m]."""

    frame: str
    ends: Array
    radius: float


@dataclass(frozen=True)
class Block:
    """An obstacle in a frame. rotation: (3, 3); centre, size: (3,) [m]."""

    frame: str
    rotation: Array
    centre: Array
    size: Array


@dataclass(frozen=True)
class MovingScene:
    """Frames from the world outwards, and the shapes fixed to them."""

    frames: tuple[Frame, ...]
    rods: tuple[Rod, ...]
    blocks: tuple[Block, ...]


def moving_scene(config: Config) -> MovingScene:
    """The scene of a configured arm. Raises ConfigError, ArmFileError."""
    return _spatial(config) if config.is_chain else _planar(config)


def _spatial(config: Config) -> MovingScene:
    arm, space = described_arm(config), Space.of(config)
    names = (arm.base, *(joint.link for joint in arm.joints))
    fixed = Frame(names[0], WORLD, rotation_of(*config.arm.base), np.zeros(3), np.zeros(3), None)
    moving = [
        Frame(name, parent, turn, shift, axis, joint)
        for joint, (parent, name, turn, shift, axis) in enumerate(zip(names, names[1:], *space.chain, strict=False))
    ]
    rods = tuple(Rod(names[each.link], each.ends, each.radius) for each in space.shapes.capsules)
    blocks = tuple(Block(names[0], box[:3], box[3], 2.0 * box[4]) for box in space.boxes)
    return MovingScene((fixed, *moving), rods, blocks)


def _planar(config: Config) -> MovingScene:
    """Scene of a planar arm: angles are measured from the horizontal x axis; with gravity, the plane is vertical."""
    lengths = [float(length) for length in config.arm.link_lengths or (1.0,) * len(config.joints)]
    upright = rotation_of(0.5 * np.pi, 0.0, 0.0) if config.arm.gravity else np.eye(3)
    frames = [Frame(BASE, WORLD, upright, np.zeros(3), np.zeros(3), None)]
    rods = []
    at, about = np.zeros(3), np.array([0.0, 0.0, 1.0])
    for number, (joint, length) in enumerate(zip(config.joints, lengths, strict=True)):
        name = f"link_{number + 1}" if joint.name in ("", BASE, WORLD) else joint.name
        frames.append(Frame(name, frames[-1].name, np.eye(3), at, about, number))
        at = np.array([length, 0.0, 0.0])
        rods.append(Rod(name, np.stack([np.zeros(3), at]), PLANAR_RADIUS * length))
    return MovingScene(tuple(frames), tuple(rods), ())
