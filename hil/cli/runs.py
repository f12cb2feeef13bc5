"""The subcommands that list runs, name and annotate a run, and compare two runs.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil import strict_json
from hil.cli.options import Json, RunPath

_WHOLE = 100.0
"""Detectable change [%] above which no value is printed for a term: the runs then reveal nothing about that term."""

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hil.estimation.changes.diff import Difference
    from hil.runs.collection import RunSummary


def runs(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder that holds the run folders.")] = Path("runs"),
    json_only: Json = False,
) -> None:
    """List the runs in a folder: arm, date, verdict, residual, name and note."""
    from hil.runs.collection import find_runs

    found = find_runs(folder)
    if json_only:
        print(strict_json.dumps({"runs": [run.to_json() for run in found]}))
        return
    if not found:
        print(f"No runs in {folder}. `hil identify ARM.toml` creates one.")
        return
    _print_runs(found)


def _print_runs(found: "list[RunSummary]") -> None:
    """Print a table; if the terminal is too narrow, put each run's path on a separate line so that it can be copied."""
    from rich.markup import escape
    from rich.table import Table

    from hil.printing import natural_width, print_table, result_console, say

    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for heading in ("run", "arm", "when", "verdict", "residual", "name, note"):
        table.add_column(heading, no_wrap=True, justify="right" if heading == "residual" else "left")
    rows = []
    for run in found:
        when = f"{run.started:%Y-%m-%d %H:%M}" if run.started else "-"
        residual = "-" if run.residual is None else f"{run.residual:.3f}"
        said = ": ".join(each for each in (run.note.name, run.note.text) if each)
        rows.append((str(run.path), run.arm, when, run.verdict, residual, said))
        table.add_row(*(escape(each) for each in rows[-1]))
    console = result_console()
    if not console.is_terminal or natural_width(console, table) <= console.width:
        print_table(console, table)
        return
    for path, arm, when, verdict, residual, said in rows:
        print(path)
        say(console, "  " + ", ".join(each for each in (arm, when, verdict, f"residual {residual}", said) if each))


def note(
    run: RunPath,
    name: Annotated[str | None, typer.Option("--name", help="Short name, shown by `hil runs`.")] = None,
    text: Annotated[str | None, typer.Option("--text", help="Free text.")] = None,
) -> None:
    """Give a run a name and a note; without options, print them."""
    from hil.runs.collection import Note, read_note, write_note

    kept = read_note(run)
    if name is not None or text is not None:
        kept = Note(kept.name if name is None else name, kept.text if text is None else text)
        write_note(run, kept)
    print(": ".join(each for each in (kept.name, kept.text) if each) or "no name, no note")


def diff(
    before: Annotated[Path, typer.Argument(metavar="RUN", help="Earlier run (or result.json, or exported TOML).")],
    after: Annotated[Path, typer.Argument(metavar="RUN", help="Later run of the same arm.")],
    png: Annotated[
        Path | None, typer.Option("--png", metavar="FILE", help="Plot the differences; needs the `png` extra.")
    ] = None,
    json_only: Json = False,
) -> None:
    """Compare two runs of an arm and test which parameters changed significantly, for example because of wear."""
    from hil.estimation.changes.diff import diff_runs

    difference = diff_runs(before, after)
    if png is not None:
        from hil.report.diff_plot import save_diff_plot

        save_diff_plot(difference, png)
    if json_only:
        print(strict_json.dumps(difference.to_json()))
        return
    _print_difference(difference)
    if png is not None:
        print(f"Plot: {png}")


def _print_difference(difference: "Difference") -> None:
    from rich.markup import escape
    from rich.table import Table

    from hil.printing import print_fitting, result_console, say

    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column("parameter", no_wrap=True)
    for heading in ("before", "after", "change [%]", "in std."):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("")
    for change in difference.changes:
        percent = "-" if change.percent is None else f"{change.percent:+.2f}"
        shown = (f"{change.before:.5g}", f"{change.after:.5g}", percent, f"{change.z:+.1f}")
        table.add_row(escape(change.name), *shown, "changed" if change.changed else "")
    console = result_console()
    print_fitting(console, table)
    for lacking, names in (("later", difference.only_before), ("earlier", difference.only_after)):
        if names:
            say(console, f"Not in the {lacking} model: {', '.join(names)}.")
    for line in (*difference.doubts, *_would_show(difference.detectable)):
        say(console, line)
    if any(": " in change.name for change in difference.changes):
        say(console, 'A row "friction_i: TERM" assumes that only this term of the friction of joint i has changed.')
    # Such a row already names the term that changed.
    whole = {change.name.partition(": ")[2] for change in difference.changed if ": " in change.name}
    found = ", ".join(change.name for change in difference.changed if change.name not in whole)
    say(console, f"Significant changes: {found}." if found else "No significant changes.")


def _would_show(detectable: "Mapping[str, float]") -> list[str]:
    """Describe the smallest change [%] that two runs like these would reveal if only one friction term changed."""
    least = [f"{name} {percent:.2g} %" for name, percent in detectable.items() if percent <= _WHOLE]
    never = [name for name, percent in detectable.items() if percent > _WHOLE]
    lines = []
    if least:
        known = "Smallest change in each term that 95 of 100 pairs of runs like these would detect"
        lines.append(f"{known}: {', '.join(least)}.")
    if never:
        lines.append(f"For these terms, not even a doubling would be detected: {', '.join(never)}.")
    return lines
