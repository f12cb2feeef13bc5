"""The examples, on the realistic fake arm: what they print must show that the model helps."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
LEAST_IMPROVEMENT = 3.0


@pytest.mark.parametrize("name", ["feed_forward", "gravity_compensation"])
def test_the_model_makes_errors_several_times_smaller(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / f"{name}.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    times = [float(found) for found in re.findall(r"([\d.]+) times smaller", done.stdout)]
    assert len(times) == 2
    assert min(times) >= LEAST_IMPROVEMENT, done.stdout
