"""The `hil` command: its subcommands in the order in which the help lists them, and its error handling.

The modules imported here only define the arguments of the subcommands; those that do the work are imported inside the
commands, so that `hil --help` responds immediately.
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Annotated, NoReturn

import typer

from hil import __version__
from hil.cli import bus, data, dry_run, experiment, fake_command, init, results, runs, schema, study
from hil.cli.errors import Command, exit_code, message, stop_behind
from hil.cli.output import bounded_output, readable_output, require_output
from hil.cli.stopped import same_again
from hil.cli.verbosity import with_verbosity
from hil.errors import StopRequested

app = typer.Typer(
    name="hil",
    help="Identify the dynamics of Dynamixel servo arms, on a real bus or a fake one.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    allow_code: Annotated[
        bool,
        typer.Option("--allow-code", help="Run the code that the file names in [fake] plant. Read that code first."),
    ] = False,
) -> None:
    del allow_code  # handled in main, wherever it appeared on the command line
    if version:
        print(f"hil {__version__}", flush=True)
        raise typer.Exit


COMMANDS: dict[str, tuple[Callable[..., None], str]] = {
    "identify": (experiment.identify, "configs/fake_two_link.toml"),
    "record": (experiment.record, "configs/fake_two_link.toml --out runs/monday"),
    "estimate": (experiment.estimate, "runs/20261121-153000-fake_two_link"),
    "scan": (bus.scan, "/dev/ttyUSB0"),
    "check": (bus.check, "configs/my_arm.toml"),
    "pose": (bus.pose, "configs/fake_viperx_300.toml --guide"),
    "setup": (bus.setup, "/dev/ttyUSB0 --baud 57600 --id 1 --new-id 2 --new-baud 1000000 --return-delay-us 0"),
    "report": (results.report, "runs/20261121-153000-fake_two_link --png pictures"),
    "export": (results.export, "runs/20261121-153000-fake_two_link --format urdf --format mjcf"),
    "init": (init.init, "/dev/ttyUSB0 --out my_arm.toml"),
    "dry-run": (dry_run.dry_run, "configs/first_time.toml --picture dry_run.png"),
    "runs": (runs.runs, "runs"),
    "note": (runs.note, 'runs/20261121-153000-fake_two_link --text "new gearbox"'),
    "diff": (runs.diff, "runs/before runs/after --png wear.png"),
    "study": (study.study, "studies/seeds.toml --workers 2"),
    "compare": (data.compare, "runs/20261121-153000-fake_two_link"),
    "calibrate": (data.calibrate, "runs/bare runs/with_mass --mass 0.1 --distance 0.16 --length 0.147"),
    "fake": (fake_command.fake, "koch --pty --link /tmp/arm"),
    "hand": (fake_command.hand, "/tmp/arm 2:to=0.5 3:ticks=2500,duration=2"),
    "schema": (schema.schema, "--out hil.schema.json"),
}
"""For each subcommand, by name: its function, and the arguments shown in its usage example."""

ALLOW_CODE = "--allow-code"


@contextmanager
def _code_as_asked() -> Iterator[None]:
    """Accept --allow-code anywhere on the command line: any subcommand can open a file whose [fake] table names a
    function.
    """
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    asked = ALLOW_CODE in words[:end]
    if asked:
        from hil.fakes import allow_code

        sys.argv[1:] = [word for word in words[:end] if word != ALLOW_CODE] + words[end:]
        allow_code()
    try:
        yield
    finally:
        if asked:
            allow_code(False)


for _name, (_command, _example) in COMMANDS.items():
    app.command(_name, cls=Command, epilog=f"Example: hil {_name} {_example}")(with_verbosity(_command))


@cache
def _built() -> Callable[[], object]:
    """Return the Click command, cached because Typer takes 10 ms to build it."""
    return typer.main.get_command(app)


def _one_blas_thread() -> None:
    """Limit BLAS to one thread unless the user chose a number. BLAS reads the number when numpy is first imported.

    hil's matrices are small. On two busy cores, two spinning threads took 91 ms for a singular value decomposition that
    one thread finished in 1 ms.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def main() -> NoReturn:
    """Run the command line; turn an expected error into a message on standard error and an exit code."""
    _one_blas_thread()
    require_output()
    with bounded_output():
        _run()
    sys.exit(0)


def _run() -> None:
    """Run the command; exit with a code other than 0 if it fails."""
    try:
        with _code_as_asked(), readable_output():
            _built()()
    except Exception as raised:
        error = stop_behind(raised) or raised
        code = exit_code(error)
        if code is None:
            raise
        said = [message(error), *(same_again(error) if isinstance(error, StopRequested) else [])]
        try:
            print("\n".join(said), file=sys.stderr)
            sys.stdout.flush()
        except OSError:  # the terminal is closed: nobody reads this, and Python would fail again on exit
            os._exit(code)
        sys.exit(code)
