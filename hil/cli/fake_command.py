"""The subcommand `hil fake`: what it takes. hil.cli.fake does the work, imported when it is asked to."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import ConfigPath
from hil.cli.verbosity import is_quiet


def _list_faults(wanted: bool) -> None:
    if wanted:
        from hil.cli import fake as work

        work.list_faults()
        raise typer.Exit


def fake(
    config: ConfigPath,
    pty: Annotated[bool, typer.Option("--pty", help="Serve it on a terminal device until Ctrl-C or SIGTERM.")] = False,
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="Symbolic link to that device.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND[:KEY=VALUE,...]", help="Let this go wrong; may be repeated. See --list-faults."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of noise and faults, instead of the file's.")] = None,
    _: Annotated[
        bool,
        typer.Option("--list-faults", is_eager=True, callback=_list_faults, help="Print the kinds of faults and exit."),
    ] = False,
) -> None:
    """Serve the fake arm of a file to any program, in real time; without --pty, say what it is made of."""
    from hil.cli import fake as work

    if pty:
        work.serve_fake(config, link, fault or [], seed, is_quiet())
    else:
        work.describe_fake(config, fault or [], seed)
