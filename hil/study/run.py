"""Run a study: send specifications to the workers and write the returned rows to the dataset."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from hil import __version__
from hil.errors import ConfigError, RunFolderError
from hil.runs.run_folder import write_json
from hil.study.checks import arm_toml, check_study
from hil.study.dataset import Dataset
from hil.study.draw import drawn, recordings
from hil.study.engine import workers
from hil.study.schema import Study
from hil.study.work import Row, Spec, work

if TYPE_CHECKING:
    from distributed import Client

_AHEAD = 8
"""Number of runs queued per worker in addition to the current one: no worker waits, and memory use stays constant."""

_ROWS_A_PART, _SECONDS_A_PART = 1000, 5.0

DEFAULT_COLUMNS = {
    "identify": (
        *("parameters.*.value", "parameters.*.std", "extra.*.value", "extra.*.std", "truth.*"),
        *("verdict.trust", "fit.residual_rms_ticks.*", "fit.model", "validation.held_out_rms.*", "model_choice.chosen"),
    ),
    "dry_run": ("*",),
    "empty": ("*",),
}
DEFAULT_COLUMNS["estimate"] = (*DEFAULT_COLUMNS["identify"], "recording", "config")


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a study; failed: number of runs that ended in an error; dashboard: URL of Dask's dashboard."""

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
    """Do all runs that have no row yet.

    Raises ConfigError, RunFolderError or MissingExtra before anything runs.
    """
    runs = check_study(study, out)
    dataset = _opened(study, out, runs, resume)
    missing = sorted(set(range(runs)) - dataset.done())
    if missing:
        with workers(study.engine, scheduler, worker_count) as client:
            _work_through(client, study, out, missing, dataset, runs, watch)
    dataset.compact()
    return dataset


def _opened(study: Study, out: Path, runs: int, resume: bool) -> Dataset:
    """Open the dataset in `out`, which must be new or belong to the same study."""
    rows, copy = out / "rows", out / "study.toml"
    text = study.path.read_bytes()
    if copy.is_file():
        if not resume:
            raise RunFolderError(
                f"{out} already holds a study: continue it with --resume, or choose another folder with --out."
            )
        if copy.read_bytes() != text:
            raise ConfigError(f"{study.path} is not the study that {out} holds ({copy} differs): it cannot be resumed.")
    elif resume and not out.is_dir():
        raise RunFolderError(f"{out} holds no study to resume.")
    try:
        rows.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(text)
    except OSError as error:
        raise RunFolderError(f"{out} cannot be written: {error.strerror}.") from error
    write_json(out / "about.json", {"schema": 1, "hil": __version__, "runs": runs, "seed": study.study.seed})
    return Dataset(rows)


def specifications(study: Study, out: Path, numbers: list[int]) -> Iterator[Spec]:
    """Yield the specification of each run, created on demand."""
    columns = tuple(study.keep.columns or DEFAULT_COLUMNS[study.study.task])
    found = recordings(study) if study.study.task == "estimate" else []
    for run in numbers:
        keep_in = str(out.absolute() / "runs" / f"{run:06d}") if study.keep.run_folders else None
        recording = str(found[run].absolute()) if found else None
        yield Spec(run, study.study.task, arm_toml(study, run), drawn(study, run), columns, recording, keep_in)


def _work_through(
    client: "Client", study: Study, out: Path, numbers: list[int], dataset: Dataset, runs: int, watch: Watch
) -> None:
    """Keep all workers supplied and write the rows as they arrive; rows received are written even after an error."""
    from distributed import as_completed

    waiting = specifications(study, out, numbers)
    window = max(1, len(client.scheduler_info()["workers"])) * (1 + _AHEAD)
    futures = as_completed(
        [client.submit(work, spec, key=_key(spec), pure=False) for spec in islice(waiting, window)],
        loop=client.loop,
        with_results=True,
    )
    rows: list[Row] = []
    done, failed, began, written = runs - len(numbers), _failed(dataset), time.monotonic(), time.monotonic()
    first = done
    try:
        for future, row in futures:
            rows.append(row)
            future.release()
            for spec in islice(waiting, 1):
                futures.add(client.submit(work, spec, key=_key(spec), pure=False))
            done, failed = done + 1, failed + (row["status"] != "done")
            if len(rows) >= _ROWS_A_PART or time.monotonic() - written > _SECONDS_A_PART:
                dataset.append(rows)
                rows, written = [], time.monotonic()
            left = (time.monotonic() - began) / (done - first) * (runs - done)
            watch(StudyProgress(done, runs, failed, left, client.dashboard_link or ""))
    finally:
        dataset.append(rows)


def _key(spec: Spec) -> str:
    return f"run-{spec.run}"


def _failed(dataset: Dataset) -> int:
    table = dataset.table()
    return (
        sum(status != "done" for status in table.column("status").to_pylist()) if "status" in table.schema.names else 0
    )
