"""Store an arm's capsules next to the copy of its description, because the meshes are not copied."""

import json
from pathlib import Path

import numpy as np

from hil.clearance.shapes import Capsule, Shapes, shapes_of
from hil.description.arm import ArmDescription, ArmFileError


def keep_shapes(arm: ArmDescription, folder: Path) -> None:
    """Write the capsules of `arm` to `folder`, next to the copy of its description. Raises ArmFileError, OSError."""
    shapes = shapes_of(arm)
    capsules = [[each.link, *each.ends.reshape(-1).tolist(), each.radius] for each in shapes.capsules]
    said = {"names": shapes.names, "guessed": shapes.guessed, "doubts": shapes.doubts, "capsules": capsules}
    _path(folder / arm.path.name).write_text(json.dumps(said), encoding="utf-8")


def known_shapes(arm: ArmDescription) -> Shapes:
    """The stored capsules if they were computed for these links, otherwise newly computed ones. Raises ArmFileError."""
    path = _path(arm.path)
    if not path.is_file():
        return shapes_of(arm)
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        rows = np.array(said["capsules"], dtype=np.float64).reshape(-1, 8)
        capsules = tuple(Capsule(int(row[0]), row[1:7].reshape(2, 3), float(row[7])) for row in rows)
        found = Shapes(tuple(said["names"]), capsules, tuple(said["guessed"]), tuple(said.get("doubts", ())))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArmFileError(f"{path}: the capsules of the arm cannot be read: {error}") from error
    return found if found.names == (arm.base, *(joint.link for joint in arm.joints)) else shapes_of(arm)


def _path(description: Path) -> Path:
    return description.with_name(f"{description.name}.shapes.json")
