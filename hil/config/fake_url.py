"""URLs of fake arms; their paths are relative to the configuration file that names them."""

import os
from pathlib import Path

FAKE_URL = "fake://"


def url_from(url: str, file: Path) -> str:
    """The URL with a fake arm's path resolved against the folder of the configuration `file`; other URLs are
    unchanged.

    An empty path means the file itself. The name of a bundled arm is left unchanged.
    """
    if not url.startswith(FAKE_URL):
        return url
    path, query, value = url.removeprefix(FAKE_URL).partition("?")
    beside = file.absolute().parent / path if path else file
    is_name = path == Path(path).name and not Path(path).suffix and not beside.exists()
    return url if path and is_name else f"{FAKE_URL}{beside.resolve()}{query}{value}"


def url_for(url: str, file: Path) -> str:
    """The URL of an open port as it is written in the configuration `file`, with a fake arm's path relative to that
    file.
    """
    path, query, value = url.removeprefix(FAKE_URL).partition("?")
    if not url.startswith(FAKE_URL) or Path(path).is_absolute() or not Path(path).is_file():
        return url
    relative = Path(os.path.relpath(path, file.absolute().parent)).as_posix()
    return f"{FAKE_URL}{relative}{query}{value}"
