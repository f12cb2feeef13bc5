"""Arguments of the subcommands for fake arms; hil.cli.fake does the work and is imported on demand."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.verbosity import is_quiet


def _list_faults(wanted: bool) -> None:
    if wanted:
        from hil.cli import fake as work

        work.list_faults()
        raise typer.Exit


def fake(
    config: Annotated[
        Path, typer.Argument(metavar="ARM", help="TOML file with a [fake] table, or an arm's name (see above).")
    ],
    pty: Annotated[
        bool, typer.Option("--pty", help="Serve the arm on a pseudo-terminal until Ctrl-C or SIGTERM.")
    ] = False,
    link: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Create this symbolic link to the pseudo-terminal.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND[:KEY=VALUE,...]", help="Inject this fault; may be repeated. See --list-faults."),
    ] = None,
    move: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID:to=RAD[,at=S,duration=S]",
            help="Let a simulated hand move this servo's joint while its torque is off. ID:ticks=POSITION gives the "
            "target in encoder ticks. May be repeated.",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed for noise and faults, overriding the file's.")] = None,
    _: Annotated[
        bool,
        typer.Option("--list-faults", is_eager=True, callback=_list_faults, help="List the fault kinds and exit."),
    ] = False,
) -> None:
    """Serve a fake arm to any program in real time; without --pty, describe it.

    Arms by name: koch, viperx_300, open_manipulator_x, fake_two_link and the other fake arms that come with hil.
    """
    from hil.cli import fake as work

    if pty:
        work.serve_fake(config, link, fault or [], move or [], seed, is_quiet())
    else:
        work.describe_fake(config, fault or [], move or [], seed)


def hand(
    device: Annotated[Path, typer.Argument(metavar="DEVICE", help="The device that `hil fake --pty` serves.")],
    moves: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ID:to=RAD]...", help="Servo and target angle, or ID:ticks=POSITION; optional: ,at=S,duration=S."
        ),
    ] = None,
    release: Annotated[list[int] | None, typer.Option(metavar="ID", help="Release this servo's joint.")] = None,
) -> None:
    """Move joints of a fake arm while their torque is off, as a person does when calibrating an arm by hand.

    If torque is on at any of these joints, nothing moves, and the exit code is 2.
    """
    from hil.cli import fake as work

    work.move_by_hand(device, moves or [], release or [])
