"""Standard output that a reader closed early, or that is full: both after the work, which is in its folder."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer


@contextmanager
def readable_output() -> Iterator[None]:
    """A closed pipe (`| head -1`) is no failure; a full disk is one, and says so."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
        raise typer.Exit(0) from None
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _drop_output()
        said = "hil: standard output cannot be written: no space left. What was finished is in its folder."
        print(said, file=sys.stderr)
        raise typer.Exit(1) from None


def _drop_output() -> None:
    """Discard buffered output; otherwise Python would try to write it again at exit and report an error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
