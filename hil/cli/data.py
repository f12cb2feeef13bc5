"""The subcommands about data: CSV files from elsewhere, peers on the same recording, a known mass.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil import strict_json
from hil.errors import ConfigError

if TYPE_CHECKING:
    from hil.results.result import ShootingResult
    from hil.runs.run_folder import RunFolder

Runs = Annotated[
    list[Path], typer.Argument(metavar="RUN | FILE.csv ..", help="Run folder, or CSV files of one arm with --config.")
]
ArmPath = Annotated[
    Path | None, typer.Option("--config", metavar="ARM.toml", help="For CSV files: [columns] says what is in them.")
]
AllSamples = Annotated[
    bool, typer.Option("--all-samples", help="No settled period is needed: every sample, by multiple shooting.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of `hil identify` or `hil record`.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object, the result, and nothing else.")]


def are_csv(paths: Sequence[Path]) -> bool:
    """Whether `hil estimate` was given CSV files; raises BadParameter for a mixture."""
    files = [path.suffix.lower() == ".csv" for path in paths]
    if any(files) and not all(files):
        raise typer.BadParameter("give either one run folder or CSV files, not both.")
    if not any(files) and len(paths) > 1:
        raise typer.BadParameter("one run folder at a time; only CSV files can be estimated together.")
    return all(files)


def estimate_csv(paths: Sequence[Path], config: Path | None, json_only: bool) -> None:
    """Estimate from CSV files by multiple shooting and print the result."""
    from hil.cli.terminal import Terminal
    from hil.estimation.unsettled_estimate import estimate_csv as estimate

    if config is None:
        raise ConfigError("A CSV file needs --config ARM.toml, whose [columns] says what its columns are.")
    with Terminal(quiet=json_only).busy("Estimating by multiple shooting"):
        result = estimate(paths, config)
    show_any(result, json_only)


def estimate_all_samples(run: "RunFolder", json_only: bool) -> None:
    """Estimate a run that holds no settled period from all its samples, by multiple shooting."""
    from hil.cli.terminal import Terminal
    from hil.estimation.unsettled_estimate import estimate_unsettled

    with Terminal(quiet=json_only).busy("Estimating by multiple shooting"):
        result = estimate_unsettled(run)
    show_any(result, json_only)


def show_any(result: "ShootingResult", json_only: bool) -> None:
    """Print a result of multiple shooting."""
    if json_only:
        print(strict_json.dumps(result.to_json()))
        return
    from hil.estimation.physical import physical_lines

    print(f"{result.joints}-joint arm, {result.config}")
    for name, entry in result.quantities.items():
        print(f"{name:22s} {entry.unit:10s} {entry.value:12.5g} {entry.std:9.1e}")
    rms = ", ".join(f"{1000 * value:.3g}" for value in result.fit.residual_rms_rad)
    for found in result.zeros or ():
        shown = ", ".join(f"{zero:.4f} +- {std:.1g}" for zero, std in zip(found.zero, found.std, strict=True))
        print(f"Encoder zeros of {found.recording or result.config}: {shown} rad.")
    print(f"{result.method}.")
    print(f"Residual {rms} mrad RMS over {result.fit.segments} segments.")
    for warning in result.warnings:
        print(f"Warning: {warning}")
    if result.model_choice is not None:
        choice = result.model_choice
        print(f"Chosen by segments left out: {choice.chosen}, error {choice.error_divided_by:.2f} times smaller.")
    if result.physical is not None:
        print("\n".join(physical_lines(result.physical)))


def compare(
    run: RunPath,
    mujoco: Annotated[bool, typer.Option("--mujoco", help="With mujoco.sysid; needs the extra `peers`.")] = False,
    json_only: Json = False,
) -> None:
    """Other methods on the same recording: RLS, EKF, UKF, IDIM-LS, the paper's, mujoco.sysid."""
    from hil.cli.terminal import Terminal
    from hil.estimation.compare import compare_run
    from hil.results.json_form import to_json
    from hil.runs.run_folder import RunFolder

    folder = RunFolder.open(run)
    with Terminal(quiet=json_only).busy("Running the peers"):
        compared = compare_run(folder, mujoco)
    if json_only:
        print(strict_json.dumps(to_json(compared)))
        return
    print(f"{'method':14s} {'seconds':>8s} {'worst error':>20s} {'held out':>9s}  settings")
    for name, found in compared.methods.items():
        worst = found.worst_relative_error
        error = "-" if worst is None else f"{100 * worst:.3f} % {found.worst_parameter}"
        shown = "-" if found.held_out_rms is None else f"{100 * found.held_out_rms:.2f} %"
        print(f"{name:14s} {found.seconds:8.3f} {error:>20s} {shown:>9s}  {found.settings}")
    print(f"Parameters and standard errors of each: {folder.path / 'compare.json'}")


def calibrate(
    without: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder without the mass.")],
    with_mass: Annotated[Path, typer.Argument(metavar="RUN_WITH_MASS", help="Run folder with it bolted on.")],
    mass: Annotated[float, typer.Option("--mass", metavar="KG", help="What was bolted to the last link.")],
    distance: Annotated[float, typer.Option("--distance", metavar="M", help="Its centre from the last joint.")],
    length: Annotated[
        float | None, typer.Option("--length", metavar="M", help="Of link 1; default known.length_1.")
    ] = None,
    inertia: Annotated[float, typer.Option("--inertia", metavar="KG_M2", help="About its own centre.")] = 0.0,
    json_only: Json = False,
) -> None:
    """Each joint's torque constant, from a second run with a known mass bolted on."""
    from hil.cli.terminal import Terminal
    from hil.estimation.calibrate import calibrate_runs, calibration_lines
    from hil.estimator.calibration import KnownMass
    from hil.results.json_form import to_json
    from hil.runs.run_folder import RunFolder

    runs = RunFolder.open(without), RunFolder.open(with_mass)
    known = runs[0].load_config().known
    if length is None and known is not None and known.length_1 is not None:
        length = known.quantities()["length_1"].value
    with Terminal(quiet=json_only).busy("Calibrating"):
        result = calibrate_runs(*runs, KnownMass(mass, distance, inertia, length or 0.0))
    print(strict_json.dumps(to_json(result)) if json_only else "\n".join(calibration_lines(result)))
