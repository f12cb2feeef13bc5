"""The examples on the realistic fake arm: their output must show that the model helps."""

import re
import runpy
import sys
from pathlib import Path

import pytest

from hil.config.bundled import bundled_configs
from hil.config.schema import load_config
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))
LEAST_IMPROVEMENT = 3.0


@pytest.fixture(scope="module")
def realistic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the realistic fake arm with a shorter period."""
    folder = tmp_path_factory.mktemp("realistic")
    text = bundled_configs()["fake_two_link"].read_text(encoding="utf-8")
    path = folder / "arm.toml"
    short = (("rate = 400.0 ", "rate = 200.0 "), ("period = 10.0 ", "period = 4.0 "), ("[0.1, 5.0]", "[0.25, 5.0]"))
    path.write_text(replaced(text, *short, ("[experiment]\n", "[experiment]\nheld_out = false\n")), "utf-8")
    config = load_config(path)
    run = RunFolder.create(folder / "run", config)
    run_experiment(config, run, path, lambda _: None)
    estimate_run(run)
    return run.path


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_model_makes_errors_several_times_smaller(
    name: str, realistic: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(sys, "argv", [f"{name}.py", str(realistic)])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    times = [float(found) for found in re.findall(r"([\d.]+) times smaller", printed)]
    assert len(times) == 2
    assert min(times) >= LEAST_IMPROVEMENT, printed
