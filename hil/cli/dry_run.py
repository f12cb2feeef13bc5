"""The command `hil dry-run` and its options; `hil.dry_run.run` does the work."""

from pathlib import Path
from typing import Annotated

import typer

from hil import strict_json
from hil.cli.options import ConfigPath, Json


def dry_run(
    config: ConfigPath,
    result: Annotated[
        Path | None, typer.Option("--result", metavar="RUN", help="Earlier run whose result replaces the prior.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", metavar="FILE", help="Also save a plot (.png, .svg) or a page with the moving arm (.html)."
        ),
    ] = None,
    arms: Annotated[int, typer.Option("--arms", min=20, max=5000, help="Number of arms to simulate.")] = 128,
    servos: Annotated[
        bool, typer.Option("--servos", help="Also read the servos' limits and measure bus timing, with torque off.")
    ] = False,
    json_only: Json = False,
) -> None:
    """Simulate the experiment on arms like yours; the exit code is 1 if a limit might be exceeded."""
    from hil.api.dry_run import dry_run as simulate
    from hil.cli.terminal import Terminal
    from hil.dry_run.chain_summary import ChainDryRun, print_chain_dry_run
    from hil.dry_run.plot import draw
    from hil.dry_run.summary import print_dry_run
    from hil.next_step import next_step
    from hil.printing import result_console
    from hil.report.dry_run_page import write_dry_run_page

    if picture is not None and not picture.absolute().parent.is_dir():
        raise typer.BadParameter(f"--picture {picture}: the folder {picture.parent} does not exist. Create it first.")
    if picture is not None and picture.suffix not in (".png", ".svg", ".html"):
        raise typer.BadParameter(f"--picture {picture}: the file name must end in .png, .svg or .html.")
    with Terminal(quiet=json_only).following(config) as follow:
        rehearsal = simulate(config, result=result, arms=arms, servos=servos, on_progress=follow)
    if picture is not None and picture.suffix == ".html":
        write_dry_run_page(rehearsal.config, rehearsal.found, picture)
    elif picture is not None:
        draw(rehearsal.config, rehearsal.prediction, picture)
    if json_only:
        print(strict_json.dumps(rehearsal.to_json()))
    elif isinstance(rehearsal.found, ChainDryRun):
        print_chain_dry_run(rehearsal.found, result_console())
    else:
        print_dry_run(rehearsal.config, rehearsal.found, result_console())
    if rehearsal.is_safe and not json_only:
        starts_from = result is not None and rehearsal.config.experiment.pilot and not rehearsal.config.is_chain
        print(next_step("identify", config, *(("--from", result) if starts_from else ())))
    if not rehearsal.is_safe:
        raise typer.Exit(1)
