"""Conversion of exceptions to messages and exit codes."""

from hil.next_step import NEXT


def exit_code(error: Exception) -> int | None:
    """Exit code of an expected error; None for a bug in the program."""
    from hil.drivers import errors as driver
    from hil.errors import HilError
    from hil.estimator.errors import EstimationError

    if isinstance(error, HilError):
        return error.exit_code
    if isinstance(error, driver.UnknownModel | driver.PortNotOpened | driver.WrongModel | driver.WrongSetting):
        return 2
    return 1 if isinstance(error, driver.DriverError | EstimationError) else None


def message(error: Exception) -> str:
    """Message with its notes and, if the error occurred while another one was handled, that error's message.

    The last line is the next command, if a note names one.
    """
    lines = [f"hil: {error}", *getattr(error, "__notes__", [])]
    cause = error.__context__
    if cause is not None and error.__cause__ is None and isinstance(cause, Exception) and exit_code(cause) is not None:
        behind = len(lines) - 1 if lines[-1].startswith(NEXT) else len(lines)
        lines.insert(behind, f"Preceded by: {cause}")
    return "\n".join(lines)
