"""The `hil` command as the tests call it."""

import sys

import pytest

from hil.cli.app import main


def hil(*arguments: object) -> int:
    """Run the command in this process; its exit code. The caller's fixtures put sys.argv back."""
    sys.argv = ["hil", *map(str, arguments)]
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)
