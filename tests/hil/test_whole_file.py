"""Files are written completely, and what is not a regular file is never replaced."""

import os
import threading
from pathlib import Path

import pytest

from hil.errors import RunFolderError
from hil.whole_file import write_whole
from tests.support.command_line import hil


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for text in ("one", "two"):
        write_whole(path, text)
        assert path.read_text() == text and list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "there" / "file")
    write_whole(link, "text")
    assert link.is_symlink() and (tmp_path / "there" / "file").read_text() == "text"


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    """As /dev/stdout is, and /dev/null, which a program that runs as root must not replace for the whole computer."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    assert hil("schema", "--out", pipe) == 0
    reader.join(10)
    assert received[0].startswith("{") and pipe.is_fifo()


@pytest.mark.parametrize(("where", "said"), [("", "is a folder"), ("missing/file", "does not exist. Create it first")])
def test_what_cannot_be_written_is_said(tmp_path: Path, where: str, said: str) -> None:
    with pytest.raises(RunFolderError, match=said):
        write_whole(tmp_path / where, "text")
