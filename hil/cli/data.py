"""The subcommands that compare recordings: `hil compare` and `hil calibrate`.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

from pathlib import Path
from typing import Annotated

import typer

from hil import strict_json
from hil.cli.options import Json, RunPath


def compare(
    run: RunPath,
    mujoco: Annotated[bool, typer.Option("--mujoco", help="Include mujoco.sysid; needs the `peers` extra.")] = False,
    json_only: Json = False,
) -> None:
    """Apply other methods to a run's recording: RLS, EKF, UKF, IDIM-LS, Zhu et al. (docs/paper.md), mujoco.sysid.

    For a spatial arm, the methods are IDIM-LS and least squares on Fourier coefficients.
    """
    from hil.cli.terminal import Terminal
    from hil.estimation.comparison.compare import compare_run
    from hil.results.json_form import to_json
    from hil.runs.run_folder import RunFolder

    folder = RunFolder.open(run)
    with Terminal(quiet=json_only).busy("Running the other methods"):
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
    print(f"Parameters and standard errors of each method: {folder.path / 'compare.json'}")


def calibrate(
    without: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of the arm without the mass.")],
    with_mass: Annotated[
        Path, typer.Argument(metavar="RUN_WITH_MASS", help="Run folder of the arm with the mass bolted on.")
    ],
    mass: Annotated[float, typer.Option("--mass", min=1e-6, metavar="KG", help="Mass bolted to the last link.")],
    distance: Annotated[
        float | None,
        typer.Option("--distance", min=1e-6, metavar="M", help="Distance from the last joint to the mass's centre."),
    ] = None,
    length: Annotated[
        float | None, typer.Option("--length", min=1e-6, metavar="M", help="Length of link 1; default: known.length_1.")
    ] = None,
    inertia: Annotated[
        float, typer.Option("--inertia", min=0.0, metavar="KG_M2", help="Inertia of the mass about its own centre.")
    ] = 0.0,
    at: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--at", metavar="X Y Z", help="Spatial arm: position of the mass in its link's frame, in m."),
    ] = None,
    joint: Annotated[
        str | None,
        typer.Option(
            "--joint", metavar="NAME", help="Spatial arm: the joint that moves that link; default: the last one."
        ),
    ] = None,
    json_only: Json = False,
) -> None:
    """Determine each joint's torque constant from a second run with a known mass bolted on."""
    from hil.cli.terminal import Terminal
    from hil.estimation.calibrate import AddedMass, calibrate_runs, calibration_lines
    from hil.results.json_form import to_json
    from hil.runs.run_folder import RunFolder

    if without.resolve() == with_mass.resolve():
        raise typer.BadParameter(f"{without} is given twice: give one run without the mass and one with it.")
    runs = RunFolder.open(without), RunFolder.open(with_mass)
    with Terminal(quiet=json_only).busy("Calibrating"):
        result = calibrate_runs(*runs, AddedMass(mass, inertia, distance, length, at, joint))
    print(strict_json.dumps(to_json(result)) if json_only else "\n".join(calibration_lines(result)))
