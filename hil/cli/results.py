"""The subcommands that work on a finished run: report and export.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import RunPath
from hil.cli.verbosity import is_quiet


def report(
    run: RunPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Output file; default: RUN/report.html.")
    ] = None,
    png: Annotated[
        Path | None, typer.Option("--png", metavar="DIR", help="Save the figures in this folder as PNG.")
    ] = None,
    svg: Annotated[
        Path | None, typer.Option("--svg", metavar="DIR", help="Save the figures in this folder as SVG.")
    ] = None,
) -> None:
    """Write the report of a run: one self-contained HTML page with verdict, parameters and figures."""
    from hil.cli.views.result_table import what_next
    from hil.model_file import read_result
    from hil.report.pictures import figures_of, save_pictures

    print(write_report(run, out))
    shown = [] if png is None and svg is None else figures_of(run)
    for kind, folder in (("svg", svg), ("png", png)):  # only the second needs an extra
        if folder is not None:
            print(f"{len(save_pictures(shown, folder, kind))} figures in {folder}")
    if not is_quiet():  # on standard error, so that the page's path stays alone on standard output
        print(what_next(read_result(run), run), file=sys.stderr)


def export(
    run: RunPath,
    formats: Annotated[
        list[str],
        typer.Option("--format", metavar="FORMAT", help="One of urdf, mjcf, toml, json, csv, parquet, mcap, mat."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Output file (a folder with --samples); default: in RUN."),
    ] = None,
    link_length: Annotated[
        float | None,
        typer.Option(min=1e-3, metavar="METRES", help="Length of link 1; needed only for a horizontal arm."),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option("--samples", metavar="N", help="Draw N arms from the posterior and write them to --out."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the draws.")] = 1,
) -> None:
    """Write the identified arm or its recording in other tools' formats, and list what a format cannot represent."""
    formats = [name.lower() for name in formats]
    if samples is not None:
        from hil.export.posterior import export_samples

        folder = out or run / "arms"
        drawn = export_samples(run, formats, folder, samples, seed, link_length)
        print(f"{len(drawn.models)} arms in {folder}")
        if drawn.inexact:
            print(
                f"Warning: {drawn.inexact} of these arms are not equivalent to the drawn ones, because no physically "
                "consistent links have the drawn values; the files of these arms say how far the torques differ.",
                file=sys.stderr,
            )
        return
    from hil.export.formats import export
    from hil.export.source import MissingPackages

    if out is not None and len(formats) > 1:
        raise typer.BadParameter("--out names a single file: give exactly one --format.")
    needs: list[str] = []
    for name in formats:
        try:
            written = export(run, name, out, link_length)
        except MissingPackages as error:
            needs += error.needs
            continue
        print(f"{written.path}")
        for missing in written.left_out[1 if written.warning else 0 :]:
            print(f"  {name.upper()} cannot represent {missing}")
        if written.warning:
            print(f"Warning: {written.warning}", file=sys.stderr)
    if needs:
        raise MissingPackages(*needs)


def write_report(run: Path, out: Path | None = None) -> Path:
    from hil.report import page
    from hil.report.recording_page import write_recording_report
    from hil.report.run_data import RunData
    from hil.runs.recording_folder import is_recording_folder

    if is_recording_folder(run):
        return write_recording_report(run, out)
    path = out or run / page.FILE_NAME
    page.write_report(RunData.load(run), path)
    return path
