"""Read an arm from a URDF or MJCF file; the root element tells the two formats apart."""

import re
from collections.abc import Sequence
from pathlib import Path

from hil.description.arm import ArmDescription
from hil.description.mjcf import read_mjcf
from hil.description.regular_file import not_a_file
from hil.description.urdf import read_urdf

_MJCF = re.compile(r"<mujoco[\s>]")


def read_arm(path: Path, joints: Sequence[str] | None = None) -> ArmDescription:
    """Read the arm formed by these joints, from the base outwards; the default is all rotating joints. Raises
    ArmFileError.
    """
    return read_mjcf(path, joints) if is_mjcf(path) else read_urdf(path, joints)


def is_mjcf(path: Path) -> bool:
    """Whether the file is MJCF; False if it cannot be read."""
    if not_a_file(path):
        return False
    try:
        return _MJCF.search(path.read_text(encoding="utf-8")) is not None
    except (OSError, UnicodeDecodeError):
        return False
