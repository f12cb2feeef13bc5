"""Add -v and -q to every subcommand; they control how much the logger `hil` writes to standard error.

-v adds log messages and -vv debug messages; -q leaves only the result on standard output and errors on standard error.
"""

import inspect
import logging
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any

import typer

from hil.cli.output import readable_output
from hil.cli.stopped import stopped_by_signals

_Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, show_default=False, help="Show log messages; -vv for details.")
]
_Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show only the result and errors.")]


def with_verbosity(command: Callable[..., None]) -> Callable[..., None]:

    @wraps(command)
    def run(*args: Any, verbose: int, quiet: bool, **options: Any) -> None:
        if verbose and quiet:
            raise typer.BadParameter("give either --verbose or --quiet, not both.")
        _set_up(verbose, quiet)
        with stopped_by_signals(), readable_output():
            command(*args, **options)

    own = inspect.signature(command)
    more = [
        inspect.Parameter("verbose", inspect.Parameter.KEYWORD_ONLY, default=0, annotation=_Verbose),
        inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_Quiet),
    ]
    run.__signature__ = own.replace(parameters=[*own.parameters.values(), *more])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, "verbose": _Verbose, "quiet": _Quiet}
    return run


def is_quiet() -> bool:
    return logging.getLogger("hil").level > logging.WARNING


def _set_up(verbose: int, quiet: bool) -> None:
    logger = logging.getLogger("hil")
    for handler in [each for each in logger.handlers if isinstance(each, _ShownOnTerminal)]:
        logger.removeHandler(handler)
    logger.setLevel(logging.NOTSET)
    shown = _ShownOnTerminal()
    shown.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s", "%H:%M:%S"))
    shown.setLevel(logging.ERROR)  # warnings are already part of the result
    if quiet:
        logger.setLevel(logging.ERROR)
    elif verbose:
        logger.setLevel(logging.INFO if verbose == 1 else logging.DEBUG)
        shown.setLevel(logging.NOTSET)
    logger.addHandler(shown)


class _ShownOnTerminal(logging.StreamHandler):  # type: ignore[type-arg]
    """A log handler for standard error; the next command that runs in the same process replaces it."""
