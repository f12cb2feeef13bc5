"""One run of a study, done by a worker: turns a specification into one flat row, even if the run fails."""

import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from hil import __version__

Cell = bool | int | float | str | None
Row = dict[str, Cell]

TIMINGS = ("seconds", "cpu_seconds", "worker")
"""Columns that depend on the machine; all others are the same on every worker."""


@dataclass(frozen=True)
class Spec:
    """Specification of one run.

    toml: the arm's file with this run's values, or "". recording: the run folder to estimate, or None. keep_in: where
    the run folder is kept, or None.
    """

    run: int
    task: str
    toml: str
    varied: Mapping[str, Cell]
    columns: tuple[str, ...]
    recording: str | None = None
    keep_in: str | None = None


def work(spec: Spec) -> Row:
    """Do one run and return its row. Raises only KeyboardInterrupt and SystemExit."""
    row: Row = {"run": spec.run, "task": spec.task, "status": "done", "message": ""}
    row |= {f"vary.{key}": value for key, value in spec.varied.items()}
    row |= {"config_sha256": sha256(spec.toml.encode()).hexdigest()[:16], "hil": __version__}
    began, used = time.perf_counter(), time.process_time()
    try:
        with threadpool_limits(limits=1):
            result = dict(flat(_done(spec)))
        row |= {name: value for name, value in result.items() if _kept(name, spec.columns)}
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        row |= {"status": "failed", "message": f"{type(error).__name__}: {error}".splitlines()[0][:500]}
        row["where"] = f"{Path(last.filename).name}:{last.lineno}"
    row |= {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - used, "worker": os.getpid()}
    return row


def flat(value: Any, prefix: str = "") -> Iterator[tuple[str, Cell]]:
    """Flatten nested dictionaries and short lists to (dotted name, plain value) pairs."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from flat(entry, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(value, list | tuple):
        if len(value) <= _MOST_ENTRIES:
            for number, entry in enumerate(value):
                yield from flat(entry, f"{prefix}.{number}")
    elif value is None or isinstance(value, bool | int | float | str):
        yield prefix, value


_MOST_ENTRIES = 8
"""Longest list that is flattened; longer ones (a covariance, a spectrum) are left out."""


def _kept(name: str, columns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in columns)


def _done(spec: Spec) -> Any:
    if spec.task == "empty":
        return {}
    if spec.task == "estimate":
        return _estimated(spec)
    folder = Path(spec.keep_in) if spec.keep_in else Path(tempfile.mkdtemp(prefix="hil-study-"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        arm = folder / "arm.toml"
        arm.write_text(spec.toml, encoding="utf-8")
        return _identified(arm, folder) if spec.task == "identify" else _dry_run(arm)
    finally:
        if spec.keep_in is None:
            shutil.rmtree(folder, ignore_errors=True)


def _identified(arm: Path, folder: Path) -> Any:
    from hil.api.experiment import identify

    shutil.rmtree(folder / "run", ignore_errors=True)  # left by a worker that died during this run
    return identify(arm, out=folder / "run").to_json()


def _dry_run(arm: Path) -> Any:
    from hil.config.schema import load_config
    from hil.dry_run.run import dry_run
    from hil.dry_run.summary import dry_run_json

    config = load_config(arm)
    return dry_run_json(config, dry_run(config))


def _estimated(spec: Spec) -> Any:
    """Estimate from a copy of the recording, so that the original folder is not changed."""
    from hil.estimation.settled_estimate import estimate_run
    from hil.runs.run_folder import RunFolder

    assert spec.recording is not None  # required for this task
    source = Path(spec.recording)
    with tempfile.TemporaryDirectory(prefix="hil-study-") as folder:
        copy = Path(folder) / "run"
        copy.mkdir()
        for path in source.iterdir():
            if path.is_file() and path.name not in ("result.json", "report.html", "period.npz"):
                shutil.copy2(path, copy / path.name)
        return {"recording": str(source), **estimate_run(RunFolder.open(copy)).to_json()}
