"""The command to type next: from `hil scan` to `hil export`, each command names its successor in its last line."""

import shlex

NEXT = "Next: "
"""Beginning of the line that names the next command."""


def next_step(*words: object) -> str:
    """The line that names the next command, quoted for a shell."""
    return f"{NEXT}{command(*words)}"


def command(*words: object) -> str:
    """A `hil` command as typed in a shell, with every word quoted that the shell would split or expand."""
    return shlex.join(["hil", *map(str, words)])
