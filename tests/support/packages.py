"""Wheels and sdists of a source tree."""

import subprocess
import sys
from pathlib import Path

import pytest


def build(kind: str, source: Path, folder: Path) -> Path:
    """The "wheel" or "sdist" of a source tree, built into `folder`."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: pip install hatchling")
    code = f"import hatchling.build; print(hatchling.build.build_{kind}({str(folder)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built
