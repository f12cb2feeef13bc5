"""Handle a closed pipe or a full disk on standard output. Results are saved first."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def require_output() -> None:
    """Exit if standard output is closed (`>&-`): the next file opened would take its place."""
    if sys.stdout is None:
        print("hil: standard output is closed. Redirect it, for example to /dev/null.", file=sys.stderr)
        sys.exit(1)


@contextmanager
def readable_output() -> Iterator[None]:
    """Treat a closed pipe (`| head -1`) as success; report a full disk as a failure."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
        sys.exit(0)
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _drop_output()
        said = "hil: cannot write to standard output: no space left. Finished results are in their folder."
        print(said, file=sys.stderr)
        sys.exit(1)


def _drop_output() -> None:
    """Discard buffered output; otherwise Python would try to write it again at exit and report an error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
