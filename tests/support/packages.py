"""Building of wheels and sdists."""

import subprocess
import sys
from pathlib import Path

import pytest


def build(kind: str, source: Path, folder: Path) -> Path:
    """Build the "wheel" or "sdist" of a source tree in `folder`."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: pip install hatchling")
    code = f"import hatchling.build; print(hatchling.build.build_{kind}({str(folder)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built
