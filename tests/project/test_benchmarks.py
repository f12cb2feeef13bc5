"""All benchmark scripts start: their --help imports everything they use."""

import os
import subprocess
import sys

import pytest

from benchmarks.period_gap import measure
from tests.support.paths import ROOT
from tests.support.processes import forked

BENCHMARKS = ROOT / "benchmarks"
NEEDS_A_CLIENT = "client_calls"
SCRIPTS = sorted(
    str(path.relative_to(BENCHMARKS))
    for path in BENCHMARKS.rglob("*.py")
    if "__main__" in path.read_text(encoding="utf-8") and path.stem != NEEDS_A_CLIENT
)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts(name: str) -> None:
    done = forked.run([str(BENCHMARKS / name), "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    assert "--json" in done.stdout


def test_the_stand_in_for_the_bus_is_one_that_a_stream_can_use() -> None:
    """The benchmark of period ends replaces the bus, so that it breaks if the stream needs more of it."""
    measured = measure(1000.0, 2.0)
    assert measured["exchanges"] > 2 * 2000 and measured["beyond_interval_ms"] >= 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts_alone(name: str) -> None:
    """Where nothing of hil was loaded before it."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    started = [sys.executable, str(BENCHMARKS / name), "--help"]
    done = subprocess.run(started, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert "--json" in done.stdout
