"""Run a study: send the specification of each run to a worker, and write the returned rows to the dataset."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hil.study.checks import arm_toml, check_study
from hil.study.dataset import Dataset
from hil.study.draw import drawn, recordings
from hil.study.engine import versions, workers
from hil.study.folder import opened
from hil.study.jobs import run_jobs
from hil.study.schema import Study
from hil.study.work import Row, Spec, lost_row, work

if TYPE_CHECKING:
    from distributed import Client

_ROWS_A_PART, _SECONDS_A_PART = 1000, 5.0

DEFAULT_COLUMNS = {
    "identify": (
        *("parameters.*.value", "parameters.*.std", "extra.*.value", "extra.*.std", "truth.*"),
        *("verdict.trust", "fit.residual_rms_ticks.*", "fit.model", "validation.held_out_rms.*", "model_choice.chosen"),
    ),
    "dry_run": ("*",),
    "fault": ("fault.*",),
    "empty": ("*",),
}
DEFAULT_COLUMNS["estimate"] = (*DEFAULT_COLUMNS["identify"], "recording", "arm_type", "config")


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a study. failed: number of runs that ended in an error. dashboard: URL of Dask's dashboard."""

    done: int
    runs: int
    failed: int
    seconds_left: float | None
    dashboard: str


Watch = Callable[[StudyProgress], None]


def run_study(
    study: Study,
    out: Path,
    *,
    resume: bool = False,
    scheduler: str | None = None,
    worker_count: int | None = None,
    watch: Watch = lambda _: None,
) -> Dataset:
    """Perform all runs that have no row yet.

    Raises MissingExtra and SchedulerLost and, before anything runs, ConfigError and RunFolderError.
    """
    runs = check_study(study, out)
    with opened(study, out, runs, resume=resume) as dataset:
        missing = sorted(set(range(runs)) - dataset.done())
        if missing:
            with workers(study.engine, scheduler, worker_count) as client:
                _work_through(client, study, out, missing, dataset, runs, watch)
        dataset.compact()
    return dataset


def specifications(study: Study, out: Path, numbers: list[int]) -> Iterator[Spec]:
    """Yield the specification of each run, created on demand."""
    columns = tuple(study.keep.columns or DEFAULT_COLUMNS[study.study.task])
    found = recordings(study) if study.study.task == "estimate" else []
    for run in numbers:
        keep_in = str(out.absolute() / "runs" / f"{run:06d}") if study.keep.run_folders else None
        recording = str(found[run].absolute()) if found else None
        yield Spec(
            run=run,
            task=study.study.task,
            toml=arm_toml(study, run),
            varied=drawn(study, run),
            columns=columns,
            seed=study.study.seed,
            versions=versions(),
            seconds=study.engine.run_seconds,
            recording=recording,
            keep_in=keep_in,
        )


def _work_through(
    client: "Client", study: Study, out: Path, numbers: list[int], dataset: Dataset, runs: int, watch: Watch
) -> None:
    specs = ((spec.run, spec) for spec in specifications(study, out, numbers))
    rows: list[Row] = []
    done, failed, began, written = runs - len(numbers), _failed(dataset), time.monotonic(), time.monotonic()
    first, dashboard = done, client.dashboard_link or ""
    try:
        for ended in run_jobs(client, work, specs):
            row = ended.result or lost_row(ended.item, ended.error)
            rows.append(row)
            done, failed = done + 1, failed + (row["status"] != "done")
            if len(rows) >= _ROWS_A_PART or time.monotonic() - written > _SECONDS_A_PART:
                dataset.append(rows)
                rows, written = [], time.monotonic()
            left = (time.monotonic() - began) / (done - first) * (runs - done)
            watch(StudyProgress(done, runs, failed, left, dashboard))
    finally:
        dataset.append(rows)


def _failed(dataset: Dataset) -> int:
    table = dataset.table()
    return (
        sum(status != "done" for status in table.column("status").to_pylist()) if "status" in table.schema.names else 0
    )
