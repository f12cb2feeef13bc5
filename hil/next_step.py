"""The command to type next: from `hil scan` to `hil export`, each command ends by naming the next one."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

NEXT = "Next: "
"""Beginning of the line that names the next command."""


def next_step(*words: object) -> str:
    """The line that names the next command, with the command quoted for a shell."""
    return f"{NEXT}{command(*words)}"


def command(*words: object) -> str:
    """A `hil` command as typed in a shell; words that the shell would split or expand are quoted."""
    return " ".join(["hil", *(_quoted(str(word)) for word in words)])


def _quoted(word: str) -> str:
    """Quote a word, as $'...' (bash) if it contains unprintable characters."""
    if word.isprintable():
        return shlex.quote(word)
    # The repr of bytes uses the same escapes, and single quotes if the bytes contain a double quote.
    return "$" + repr(os.fsencode(word) + b'"')[1:-2] + "'"


def steps_of(path: Path) -> list[Path]:
    """Folders of the pilot and of later steps in a run folder whose identification ended before the full run; otherwise
    none.
    """
    if (path / "samples.npy").is_file() or not (path / "config.toml").is_file():
        return []
    return sorted((each.parent for each in path.glob("*/samples.npy")), key=lambda each: each.stat().st_mtime)


def only_steps(path: Path, steps: Sequence[Path]) -> str:
    """Explain that an identification stopped before its full run, and how to view what was recorded."""
    names = ", ".join(each.name for each in steps)
    return (
        f"{path}: its identification ended before the full run, so there is no result; recorded: {names}. Identify "
        f"again, or look at what the arm did: {command('export', steps[-1], '--format', 'csv')}"
    )
