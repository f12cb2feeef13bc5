"""-v and -q on every subcommand: how much of the logger `hil` is shown on standard error.

Without either, a command says what it is doing and what went wrong. -v adds the log, -vv its details; -q leaves the
result on standard output and errors on standard error, nothing else.
"""

import inspect
import logging
import sys
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any

import typer

STOPPED = 130
"""Exit code of a command that Ctrl-C ended while no arm moved, as shells have it."""

_Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, show_default=False, help="Show log messages; -vv for details.")
]
_Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show only the result and errors.")]


def with_verbosity(command: Callable[..., None]) -> Callable[..., None]:
    """The subcommand with the two options beside its own."""

    @wraps(command)
    def run(*args: Any, verbose: int, quiet: bool, **options: Any) -> None:
        if verbose and quiet:
            raise typer.BadParameter("give either --verbose or --quiet, not both.")
        _set_up(verbose, quiet)
        try:
            command(*args, **options)
        except KeyboardInterrupt as stopped:  # before or after the arm moved; while it moves the stream answers
            print("\n".join(["hil: Stopped by Ctrl-C.", *getattr(stopped, "__notes__", [])]), file=sys.stderr)
            raise typer.Exit(STOPPED) from None

    own = inspect.signature(command)
    more = [
        inspect.Parameter("verbose", inspect.Parameter.KEYWORD_ONLY, default=0, annotation=_Verbose),
        inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_Quiet),
    ]
    run.__signature__ = own.replace(parameters=[*own.parameters.values(), *more])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, "verbose": _Verbose, "quiet": _Quiet}
    return run


def is_quiet() -> bool:
    """Whether -q was given."""
    return logging.getLogger("hil").level > logging.WARNING


def _set_up(verbose: int, quiet: bool) -> None:
    logger = logging.getLogger("hil")
    for handler in [each for each in logger.handlers if isinstance(each, _ShownOnTerminal)]:
        logger.removeHandler(handler)
    logger.setLevel(logging.NOTSET)
    shown = _ShownOnTerminal()
    shown.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s", "%H:%M:%S"))
    shown.setLevel(logging.ERROR)  # warnings are among the results
    if quiet:
        logger.setLevel(logging.ERROR)
    elif verbose:
        logger.setLevel(logging.INFO if verbose == 1 else logging.DEBUG)
        shown.setLevel(logging.NOTSET)
    logger.addHandler(shown)


class _ShownOnTerminal(logging.StreamHandler):  # type: ignore[type-arg]
    """On standard error, which the next command in the same process replaces."""
