"""Files that are written completely or not at all."""

from contextlib import suppress
from pathlib import Path

from hil.errors import RunFolderError, not_written

__all__ = ["replace_file", "write_whole"]


def write_whole(path: Path, text: str) -> None:
    """Write `text` to a file. A symbolic link is followed. A device or a pipe, such as /dev/stdout, is written to, not
    replaced. Raises RunFolderError.
    """
    if path.is_dir():
        raise RunFolderError(f"{path} is a folder: give the name of the file to write.")
    if not path.parent.is_dir():
        raise RunFolderError(f"{path} cannot be written: the folder {path.parent} does not exist. Create it first.")
    try:
        target = path.resolve()
        if target.exists() and not target.is_file():
            with path.open("w", encoding="utf-8") as stream:
                stream.write(text)
            return
    except OSError as error:
        raise not_written(path, error) from error
    replace_file(target, text)


def replace_file(path: Path, text: str) -> None:
    """Write a regular file, or replace it. Raises RunFolderError."""
    temporary = path.with_name(path.name + ".partial")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise not_written(path, error) from error
