"""Questions to the user at the terminal. Ctrl-C stops the command as it does elsewhere."""

from collections.abc import Callable
from typing import TypeVar

import typer

_T = TypeVar("_T")


def answer(question: str, usual: str) -> str:
    """Return the answer to a question, or `usual` if the answer is empty. Raises BadParameter if nobody can answer."""
    asked: str = _put(
        lambda: typer.prompt(question, default=usual, show_default=bool(usual), err=True),
        "Add --yes to accept every default.",
    )
    return asked.strip()


def agrees(question: str) -> bool:
    """Ask a yes-or-no question; return whether the answer is yes. Raises BadParameter if nobody can answer."""
    return _put(lambda: typer.confirm(question), "Add --yes to answer yes to every question.")


def _put(ask: Callable[[], _T], advice: str) -> _T:
    try:
        return ask()
    except typer.Abort as aborted:
        # typer turns Ctrl-C and the end of the input into the same error.
        if isinstance(stopped := aborted.__context__, KeyboardInterrupt):
            raise stopped from None
        raise typer.BadParameter(f"There is no answer to this question: the input has ended. {advice}") from None
