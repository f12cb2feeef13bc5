"""Conversion of exceptions to messages and exit codes."""

import errno
from typing import Any, TypeVar

import typer
from typer.core import TyperCommand

from hil.toml_file import shortened

_E = TypeVar("_E", bound=BaseException)

_OF_THE_MACHINE = frozenset({errno.EMFILE, errno.ENFILE})
"""Operating-system errors that are not due to the input: too many open files."""

_OF_A_PATH = frozenset({errno.ENAMETOOLONG, errno.EACCES})
"""Errors that even a check for the existence of a file can raise."""


def exit_code(error: Exception) -> int | None:
    """Return the exit code for an expected error; None for any other exception, which is a bug in the program."""
    from hil.drivers import errors as driver
    from hil.errors import HilError
    from hil.estimator.errors import EstimationError
    from hil.fakes.plants.errors import PlantError

    if any(isinstance(each, OSError) and each.errno in _OF_THE_MACHINE for each in (error, error.__cause__)):
        return 1
    if _is_of_a_path(error):
        return 2
    if isinstance(error, HilError):
        return error.exit_code
    if isinstance(error, driver.DriverError):
        of_the_input = (
            *(driver.NoControlTables, driver.UnknownModel, driver.PortNotOpened),
            *(driver.WrongModel, driver.WrongSetting),
        )
        return 2 if isinstance(error, of_the_input) and not error.after_torque else 1
    if isinstance(error, PlantError):
        return 2
    return 1 if isinstance(error, EstimationError) else None


def _is_of_a_path(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in _OF_A_PATH and bool(error.filename)


def message(error: Exception) -> str:
    """Return the text to print for an error: its message and its notes.

    If the error occurred while another expected error was being handled, the other error's message is included, unless
    both are the same. If the notes name the next command, it comes last. Control characters are escaped.
    """
    said = str(error)
    if isinstance(error, OSError) and _is_of_a_path(error):
        said = f"{shortened(str(error.filename))}: {error.strerror}."
    lines = [f"hil: {said}"]
    cause = None if error.__suppress_context__ else error.__context__
    if isinstance(cause, Exception) and exit_code(cause) is not None and str(cause) != str(error):
        lines.append(f"Preceded by: {cause}")
    text = "\n".join([*lines, *getattr(error, "__notes__", [])])
    return "".join(each if each.isprintable() or each in "\n\t" else ascii(each)[1:-1] for each in text)


class Command(TyperCommand):
    """A subcommand whose error messages show the invalid value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            cause: Any = error.__cause__  # pydantic's
            if cause:
                from hil.toml_errors import what_is_wrong

                detail = cause.errors()[0]
                error.message = f"{detail['input']} {what_is_wrong(detail)}."
            raise


def stop_behind(error: BaseException) -> Exception | None:
    """Return the stop request that was being handled when a closed terminal caused `error`; None if there was none.

    Closing a terminal sends SIGHUP; from then on, the terminal rejects all output.
    """
    from hil.errors import StopRequested

    return handled_behind(error, StopRequested) if isinstance(error, OSError) else None


def handled_behind(error: BaseException, kind: type[_E]) -> _E | None:
    """Return `error` or the exception that was being handled when it was raised, and so on, if one is of this kind."""
    seen: BaseException | None = error
    while seen is not None and not isinstance(seen, kind):
        seen = seen.__context__
    return seen
