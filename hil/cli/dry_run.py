"""The command `hil dry-run`: its options; `hil.dry_run.run` does the work."""

from pathlib import Path
from typing import Annotated

import typer

from hil import strict_json

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML file that describes the arm.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


def dry_run(
    config: ConfigPath,
    result: Annotated[
        Path | None, typer.Option("--result", metavar="RUN", help="Former run: its result in place of the prior.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Also draw it: .png or .svg.")
    ] = None,
    arms: Annotated[int, typer.Option("--arms", min=20, max=5000, help="Arms to simulate.")] = 128,
    servos: Annotated[
        bool, typer.Option("--servos", help="Also read the servos' limits and time the bus, with torque off.")
    ] = False,
    json_only: Json = False,
) -> None:
    """Simulate the experiment on arms like yours; exit code 1 if it might touch a limit."""
    from rich.console import Console

    from hil.cli.terminal import Terminal
    from hil.config.schema import load_config
    from hil.dry_run.plot import draw
    from hil.dry_run.run import dry_run as simulate
    from hil.dry_run.summary import dry_run_json, print_dry_run

    checked = load_config(config)
    with Terminal(quiet=json_only).busy("Simulating"):
        run = simulate(checked, result, arms, servos)
    if picture is not None:
        draw(checked, run.largest.prediction if run.asked is None else run.asked, picture)
    if json_only:
        print(strict_json.dumps(dry_run_json(checked, run)))
    else:
        print_dry_run(checked, run, Console(highlight=False))
    if not run.is_safe(checked):
        raise typer.Exit(1)
