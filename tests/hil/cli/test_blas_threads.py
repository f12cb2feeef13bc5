"""The command line gives BLAS one thread, unless the user chose a number."""

import os
import subprocess
import sys

import pytest

from tests.support.paths import ROOT

COMMAND = """
import sys
from contextlib import suppress
from hil.cli.app import main
sys.argv = ["hil", "--version"]
with suppress(SystemExit):
    main()
assert "numpy" not in sys.modules, "too late"
import numpy, threadpoolctl
print([pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"])
"""


@pytest.mark.parametrize(("chosen", "threads"), [({}, "[1]"), ({"OPENBLAS_NUM_THREADS": "2"}, "[2]")])
def test_blas_has_the_threads_that_the_user_chose_or_one(chosen: dict[str, str], threads: str) -> None:
    if (os.cpu_count() or 1) < 2:
        pytest.skip("one core: BLAS has one thread anyway")
    known = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", COMMAND], env=known | chosen, cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == threads
