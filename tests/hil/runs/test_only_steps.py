"""A folder whose identification was refused after its pilot: what it holds, and what to do."""

import os
from pathlib import Path

import pytest

import hil
from hil.errors import ResultError, RunFolderError
from hil.runs.collection import read_note
from hil.runs.run_folder import RunFolder


@pytest.fixture
def refused(tmp_path: Path) -> Path:
    for age, step in enumerate(("step-2", "pilot")):
        (tmp_path / "run" / step).mkdir(parents=True)
        (tmp_path / "run" / step / "samples.npy").touch()
        os.utime(tmp_path / "run" / step, (1e9 - age, 1e9 - age))
    (tmp_path / "run" / "config.toml").touch()
    return tmp_path / "run"


def test_the_last_recorded_step_is_named_in_place_of_a_run(refused: Path) -> None:
    for error, opened in ((RunFolderError, RunFolder.open), (RunFolderError, read_note), (ResultError, hil.load_model)):
        with pytest.raises(error, match=r"ended before the full run.*pilot, step-2.*hil export .*step-2"):
            opened(refused)  # type: ignore[operator]


def test_a_folder_of_runs_is_no_run_that_ended_early(refused: Path) -> None:
    (refused / "config.toml").unlink()
    with pytest.raises(RunFolderError, match="is not a run folder"):
        RunFolder.open(refused)
