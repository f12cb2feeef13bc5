"""JSON files of a run are written completely or not at all."""

import errno
from pathlib import Path

import pytest

from hil.errors import RunFolderError
from hil.runs.run_folder import write_json


def test_a_full_disk_leaves_neither_file_nor_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *_: object, **__: object) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(RunFolderError, match="cannot be written: No space left on device"):
        write_json(tmp_path / "lateness.json", {"late": 1})
    assert not list(tmp_path.iterdir())
