"""Recognition of pipes and devices, whose contents may never end or never arrive."""

from pathlib import Path
from stat import S_ISDIR, S_ISREG


def not_a_file(path: Path) -> str:
    """Return a message if a path is a pipe or a device; "" if it is neither or does not exist."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return ""
    return "" if S_ISREG(mode) or S_ISDIR(mode) else "it is a pipe or a device; save its contents in a file"
