"""The subcommands that identify, record and estimate.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil import strict_json
from hil.cli.options import ConfigPath, Json, OutPath

if TYPE_CHECKING:
    from hil.api.progress import OnProgress, Progress
    from hil.api.run import Estimation, Identification

TakeOver = Annotated[
    bool,
    typer.Option(
        "--take-over",
        help="Take over an arm whose torque is already on. It sinks, braked by its motors, for at most 60 s until it "
        "rests, then torque is cut: support it by hand.",
    ),
]
StartFrom = Annotated[
    Path | None,
    typer.Option("--from", metavar="RUN", help="Earlier run of the same arm, whose result replaces the prior."),
]
Live = Annotated[
    str,
    typer.Option(
        "--live",
        metavar="WHERE",
        help="Where to show the run: terminal, rerun (viewer), rerun:FILE.rrd or rerun:URL; see docs/commands.md.",
    ),
]
Recordings = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN | FILE ..",
        help="Run folder, or recordings of one arm (CSV, Parquet, MCAP, LeRobot dataset, ROS 2 bag).",
    ),
]
ArmPath = Annotated[
    Path | None,
    typer.Option("--config", metavar="ARM.toml", help="TOML file whose [columns] table describes the recordings."),
]
AllSamples = Annotated[
    bool, typer.Option("--all-samples", help="Use every sample, by multiple shooting; no settled period is needed.")
]


def identify(
    config: ConfigPath,
    out: OutPath = None,
    start_from: StartFrom = None,
    take_over: TakeOver = False,
    live: Live = "terminal",
    json_only: Json = False,
) -> None:
    """Excite the arm, record one settled period, and print the arm's parameters with error bars."""
    from hil.api.experiment import identify as identify_arm

    with _watching(config, live, json_only) as follow:
        result = identify_arm(config, out=out, take_over=take_over, start_from=start_from, on_progress=follow)
    _show(result, json_only)


def record(
    config: ConfigPath,
    out: OutPath = None,
    take_over: TakeOver = False,
    live: Live = "terminal",
    json_only: Json = False,
) -> None:
    """Run the experiment and store its recording for `hil estimate`."""
    from hil.api.experiment import record as record_arm
    from hil.next_step import next_step
    from hil.results.json_form import to_json
    from hil.runs.run_folder import RunFolder
    from hil.runs.timing import lost_samples

    with _watching(config, live, json_only) as follow:
        run = record_arm(config, out=out, take_over=take_over, on_progress=follow)
    if json_only:
        recorded = {"run": str(run.path), "samples": len(run.samples), "timing": to_json(run.timing)}
        print(strict_json.dumps(recorded))
        return
    print(f"Run folder: {run.path}, {len(run.samples)} samples.")
    if lost := lost_samples(run.samples, [joint.name for joint in run.config.joints]):
        print(lost)
    if seldom := RunFolder.open(run.path).load_facts().monitoring:
        print(f"Warning: {seldom}")
    print(next_step("estimate", run.path))


@contextmanager
def _watching(config: Path, live: str, json_only: bool) -> "Iterator[OnProgress]":
    """Show progress on the terminal and, if requested, in the Rerun viewer."""
    from hil.cli.terminal import Terminal
    from hil.cli.views.rerun_view import rerun_view, wants_rerun

    if live != "terminal" and not wants_rerun(live):
        raise typer.BadParameter(f"--live {live}: must be terminal, rerun, rerun:FILE.rrd or rerun:URL.")
    with Terminal(quiet=json_only).following(config) as follow:
        if live == "terminal":
            yield follow
            return
        with rerun_view(live, config) as show:

            def both(report: "Progress") -> None:
                follow(report)
                show(report)

            yield both


def estimate(
    recordings: Recordings,
    config: ArmPath = None,
    out: OutPath = None,
    all_samples: AllSamples = False,
    json_only: Json = False,
) -> None:
    """Estimate from a run's recording, or from recordings made with other tools; write result.json and the report."""
    from hil.api.estimate import are_recordings
    from hil.api.estimate import estimate as estimate_arm
    from hil.cli.terminal import Terminal

    paths: Sequence[Path] = recordings
    try:
        elsewhere = are_recordings(paths)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    elsewhere = elsewhere or not (paths[0] / "config.toml").exists()  # neither: refused by name below
    if out is not None and not elsewhere:
        raise typer.BadParameter("--out is for recordings from other tools; a run's result is written into its folder.")
    if config is not None and not elsewhere:
        raise typer.BadParameter("--config is for recordings from other tools; edit the run's own config.toml instead.")
    with Terminal(quiet=json_only).following(config) as follow:
        result = estimate_arm(paths, config=config, out=out, all_samples=all_samples, on_progress=follow)
    _show(result, json_only)


def _show(result: "Identification | Estimation", json_only: bool) -> None:
    if json_only:
        print(strict_json.dumps(result.to_json()))
        return
    from hil.api.run import Identification
    from hil.cli.views.result_table import print_result, print_shooting_result
    from hil.printing import result_console
    from hil.runs.run_folder import RunFolder

    if isinstance(result, Identification):
        config = RunFolder.open(result.run).load_config()
        print_result(result, config, result.run, result_console())
    else:
        print_shooting_result(result, result.run)
