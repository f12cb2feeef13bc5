"""All benchmark scripts start: their --help imports everything they use."""

import io
import os
import runpy
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import get_context
from pathlib import Path

import pytest

from tests.support.paths import ROOT

BENCHMARKS = ROOT / "benchmarks"
NEEDS_A_CLIENT = "client_calls"
SCRIPTS = sorted(
    str(path.relative_to(BENCHMARKS))
    for path in BENCHMARKS.rglob("*.py")
    if "__main__" in path.read_text(encoding="utf-8") and path.stem != NEEDS_A_CLIENT
)
LOADED = [
    *(
        "numpy",
        "scipy.optimize",
        "scipy.stats",
        "scipy.signal",
        "numba",
        "pydantic",
        "serial",
        "rich",
        "typer",
        "pytest",
    ),
    *("hil.api.dry_run", "hil.api.estimate", "hil.api.experiment", "hil.estimation.settled_estimate", "hil.pilot"),
]
"""What most scripts import, directly or not: it takes most of their time."""


@pytest.fixture(scope="module")
def processes() -> Iterator[ProcessPoolExecutor]:
    """A fresh process for each script, forked from one that has only loaded what most of them need."""
    context = get_context("forkserver")
    context.set_forkserver_preload(LOADED)
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        yield pool


def said_by(script: Path) -> tuple[object, str, str]:
    """Exit code and both outputs of a script run with --help, as by `python script --help`."""
    own = {name for name in sys.modules if name.split(".")[0] == "benchmarks"}
    assert not own, f"loaded before the script: {sorted(own)}"
    sys.argv = [str(script), "--help"]
    sys.path[0] = str(script.parent)
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with redirect_stdout(out), redirect_stderr(err):
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as ended:
            code = ended.code or 0
    return code, out.getvalue(), err.getvalue()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts(name: str, processes: ProcessPoolExecutor) -> None:
    code, out, err = processes.submit(said_by, BENCHMARKS / name).result()
    assert code == 0, err[-500:]
    assert "--json" in out


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts_alone(name: str) -> None:
    """Where nothing of hil was loaded before it."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    started = [sys.executable, str(BENCHMARKS / name), "--help"]
    said = subprocess.run(started, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr[-500:]
    assert "--json" in said.stdout
