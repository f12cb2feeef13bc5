"""The `hil` command: what each subcommand takes, and how errors become one message and an exit code.

The modules that do the work are imported inside the commands, so that `hil --help` answers at once.
"""

import json
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from hil import __version__

if TYPE_CHECKING:
    from hil.config import Config

app = typer.Typer(
    name="hil",
    help="Identify the dynamics of Dynamixel servo arms, on the bus or on a fake one.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the arm.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of a former `hil identify`.")]
OutPath = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default runs/TIME-ARM.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object, the result, and nothing else.")]


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        print(f"hil {__version__}")
        raise typer.Exit


@app.command(epilog="Example: hil identify configs/fake_two_link.toml")
def identify(config: ConfigPath, out: OutPath = None, json_only: Json = False) -> None:
    """Excite the arm, take one settled period, print its parameters with error bars."""
    from hil.config import load_config
    from hil.estimate import estimate_run
    from hil.experiment import run_experiment
    from hil.run_folder import RunFolder
    from hil.terminal import Terminal

    checked = load_config(config)
    run = RunFolder.create(out or _default_folder(config), checked)
    terminal = Terminal(quiet=json_only)
    with terminal.streaming(checked) as watch:
        torque = run_experiment(checked, run, config, watch)
    terminal.say(torque)
    with terminal.busy("Estimating"):
        result = estimate_run(run)
    _show(result, checked, run.path, json_only)


@app.command(epilog="Example: hil estimate runs/20261121-153000-fake_two_link")
def estimate(run: RunPath, json_only: Json = False) -> None:
    """Estimate again from a recording; writes its result.json anew."""
    from hil.estimate import estimate_run
    from hil.run_folder import RunFolder
    from hil.terminal import Terminal

    folder = RunFolder.open(run)
    terminal = Terminal(quiet=json_only)
    with terminal.busy("Estimating"):
        result = estimate_run(folder)
    _show(result, folder.load_config(), folder.path, json_only)


@app.command(epilog="Example: hil fake configs/fake_two_link.toml --pty --link /tmp/arm")
def fake(
    config: ConfigPath,
    pty: Annotated[bool, typer.Option("--pty", help="Serve it on a terminal device until Ctrl-C or SIGTERM.")] = False,
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="Symbolic link to that device.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND[:KEY=VALUE,...]", help="Let this go wrong; may be repeated. See --list-faults."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of noise and faults, instead of the file's.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No status line.")] = False,
    list_faults: Annotated[bool, typer.Option("--list-faults", help="Print the kinds of faults and exit.")] = False,
) -> None:
    """Serve the fake arm of a file to any program, in real time; without --pty, say what it is made of."""
    from hil import fake_command

    if list_faults:
        fake_command.list_faults()
    elif pty:
        fake_command.serve_fake(config, link, fault or [], seed, quiet)
    else:
        fake_command.describe_fake(config, fault or [], seed)


def main() -> NoReturn:
    """Run the command line; a foreseen error becomes its message on standard error and its exit code."""
    try:
        app()
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise
        print(_message(error), file=sys.stderr)
        sys.exit(code)
    sys.exit(0)


def _show(result: dict[str, Any], config: "Config", path: Path, json_only: bool) -> None:
    if json_only:
        print(json.dumps(result, ensure_ascii=False))
        return
    from rich.console import Console

    from hil.result_table import print_result

    print_result(result, config, path, Console(highlight=False))


def _default_folder(config: Path) -> Path:
    return Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{config.stem}"


def _exit_code(error: Exception) -> int | None:
    """The exit code of a foreseen error; None for one that is a fault of the program."""
    from drivers import errors as driver
    from estimator.errors import EstimationError
    from hil.errors import HilError

    if isinstance(error, HilError):
        return error.exit_code
    if isinstance(error, driver.UnknownModel | driver.PortNotOpened | driver.WrongModel | driver.WrongSetting):
        return 2
    return 1 if isinstance(error, driver.DriverError | EstimationError) else None


def _message(error: Exception) -> str:
    """What happened, what it happened on top of, and whether torque is off."""
    lines = [f"hil: {error}", *getattr(error, "__notes__", [])]
    cause = error.__context__
    if cause is not None and error.__cause__ is None and isinstance(cause, Exception) and _exit_code(cause) is not None:
        lines.append(f"This came after: {cause}")
    return "\n".join(lines)
