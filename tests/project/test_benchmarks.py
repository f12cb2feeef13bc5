"""All benchmark scripts start: their --help imports everything they use."""

import subprocess
import sys

import pytest

from tests.support.paths import ROOT

BENCHMARKS = ROOT / "benchmarks"
SHARED = (
    "__init__",
    "elastic_slip",
    "machine",
    "pty",
    "population_arms",
    "population_others",
    "client_calls",
)
SCRIPTS = sorted(path.stem for path in BENCHMARKS.glob("*.py") if path.stem not in SHARED)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts(name: str) -> None:
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=BENCHMARKS.parent, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert "--json" in done.stdout
