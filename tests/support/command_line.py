"""The `hil` command as called by the tests."""

import sys

import pytest

from hil.cli.app import main


def hil(*arguments: object) -> int:
    """Run the command in this process and return its exit code. The caller's fixtures restore sys.argv."""
    sys.argv = ["hil", *map(str, arguments)]
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)
