"""Building of wheels and sdists."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.paths import ROOT

FOLDERS = ("drivers", "estimator", "fakes", "hil")


def build(kind: str, source: Path, folder: Path) -> Path:
    """Build the "wheel" or "sdist" of a source tree in `folder`."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: pip install hatchling")
    code = f"import hatchling.build; print(hatchling.build.build_{kind}({str(folder)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built


def unpack(wheel: Path, folder: Path) -> None:
    """Unpack a wheel, with the loops that the checkout has compiled: the same code is not compiled twice."""
    zipfile.ZipFile(wheel).extractall(folder)
    for source in (found for top in FOLDERS for found in (ROOT / top).rglob("*.[pn][yb]*")):
        within = source.relative_to(ROOT)
        target = folder / within if within.parts[0] == "hil" else folder / "hil" / within
        if source.suffix in {".nbc", ".nbi"} and target.parent.parent.is_dir():
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(source, target)
        elif target.is_file():
            shutil.copystat(source, target)  # numba compares the dates of sources
