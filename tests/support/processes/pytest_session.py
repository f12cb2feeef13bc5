"""A pytest session of somebody else's tests, in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path


def run_pytest(folder: Path, *plugins: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run all tests of `folder`. plugins: values of pytest's option -p."""
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *(f"-p{each}" for each in ("no:cacheprovider", *plugins)), "."],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
