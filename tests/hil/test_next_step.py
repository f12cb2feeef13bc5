"""The next command is one that a shell understands, whatever the file's name."""

import shutil
import subprocess

import pytest

from hil.next_step import command


@pytest.mark.parametrize(
    "name", [b"plain.toml", b"t/ok\xff.toml", b"it's \x1b[31m\\n\xff0.toml", "müde\n$HOME.toml".encode()]
)
def test_a_shell_passes_on_the_name_that_was_given(name: bytes) -> None:
    line = command("check", name.decode("utf-8", "surrogateescape"))
    assert line.isprintable()
    if bash := shutil.which("bash"):
        typed = line.replace("hil check ", "printf %s ", 1)
        assert subprocess.run([bash, "-c", typed], capture_output=True, check=True).stdout == name
