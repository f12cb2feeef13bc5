"""An output folder that somebody deletes while an estimate from a file is running."""

import shutil
from pathlib import Path

import pytest

from hil.api import estimate as module
from hil.errors import RunFolderError


def test_a_folder_deleted_during_an_estimate_is_an_error_and_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, folder = tmp_path / "arm.csv", tmp_path / "out"
    file.write_text("t,q1,tau1\n", encoding="utf-8")

    def deleted(*_: object) -> None:
        shutil.rmtree(folder)
        raise RunFolderError(f"{folder} cannot be written.")

    monkeypatch.setattr(module, "estimate_recordings", deleted)
    with pytest.raises(RunFolderError, match="out cannot be written") as stop:
        module.estimate(file, out=folder)
    assert not folder.exists() and not isinstance(stop.value.__context__, FileNotFoundError)
