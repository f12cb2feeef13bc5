"""How errors become one message and an exit code."""


def exit_code(error: Exception) -> int | None:
    """The exit code of a foreseen error; None for a bug in the program."""
    from hil.drivers import errors as driver
    from hil.errors import HilError
    from hil.estimator.errors import EstimationError

    if isinstance(error, HilError):
        return error.exit_code
    if isinstance(error, driver.UnknownModel | driver.PortNotOpened | driver.WrongModel | driver.WrongSetting):
        return 2
    return 1 if isinstance(error, driver.DriverError | EstimationError) else None


def message(error: Exception) -> str:
    """What happened, which earlier error it followed, and whether torque is off."""
    lines = [f"hil: {error}", *getattr(error, "__notes__", [])]
    cause = error.__context__
    if cause is not None and error.__cause__ is None and isinstance(cause, Exception) and exit_code(cause) is not None:
        lines.append(f"Preceded by: {cause}")
    return "\n".join(lines)
