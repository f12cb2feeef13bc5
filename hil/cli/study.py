"""`hil study`: many runs on many workers."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil import strict_json
from hil.cli.options import Json
from hil.cli.verbosity import is_quiet

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from hil.study.run import StudyProgress


def study(
    study_path: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="TOML file: what to vary, run and record.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Output folder; default: studies/NAME.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a study that was interrupted.")] = False,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help='Dask scheduler, such as "tcp://HOST:8786", or "slurm".'),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Local processes; default: one per core.")
    ] = None,
    json_only: Json = False,
) -> None:
    """Run a study on local cores or a cluster; write one row per run, summary figures and an HTML page."""
    from dataclasses import asdict

    from rich.console import Console

    from hil.errors import MissingExtra
    from hil.study.schema import load_study

    try:
        from hil.study.page import FILE_NAME, write_page
        from hil.study.run import run_study
    except ImportError as error:
        raise MissingExtra(
            f"hil study needs the `study` extra ({error.name} is missing): pip install 'hil[study]'."
        ) from error
    checked = load_study(study_path)
    folder = out or Path("studies") / study_path.stem
    console = Console(stderr=True, quiet=json_only or is_quiet(), highlight=False)
    with _shown(console) as watch:
        dataset = run_study(checked, folder, resume=resume, scheduler=scheduler, worker_count=workers, watch=watch)
    table = dataset.table()
    found = write_page(table, f"{study_path.stem}: {table.num_rows} runs", folder / FILE_NAME)
    if json_only:
        print(strict_json.dumps({"out": str(folder), **asdict(found)}))
        return
    low, high = found.done.interval
    print(
        f"{found.done.count} of {found.done.of} runs succeeded "
        f"(95 % confidence interval of the success rate: {100 * low:.1f} to {100 * high:.1f} %)."
    )
    for message, count in list(found.failures.items())[:10]:
        print(f"  {count} failed: {message}")
    for name, rates in found.categories.items():
        if len(rates) > 1:
            print(f"{name}: " + ", ".join(f"{value} {rate.count}" for value, rate in rates.items()))
    print(f"Rows: {folder / 'rows'} (Parquet), page: {folder / FILE_NAME}")


class _shown:  # noqa: N801, a context manager that reads as a verb
    def __init__(self, console: "Console") -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task("starting workers", total=None)

    def __enter__(self) -> "Callable[[StudyProgress], None]":
        self._bar.start()
        return self._show

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _show(self, progress: "StudyProgress") -> None:
        failed = f", {progress.failed} failed" if progress.failed else ""
        where = f" ({progress.dashboard})" if progress.dashboard else ""
        self._bar.update(self._task, description=f"runs{failed}{where}", total=progress.runs, completed=progress.done)
