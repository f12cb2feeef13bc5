"""One run of a study, performed by a worker: turns a specification into one flat row, even if the run fails."""

import ctypes
import io
import os
import shutil
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from hil.study.engine import versions

Cell = bool | int | float | str | None
Row = dict[str, Cell]

TIMINGS = ("seconds", "cpu_seconds", "worker")
"""Columns that depend on the machine; all others are the same on every worker."""


_STATE = "XDG_STATE_HOME"

_ONE_AT_A_TIME = threading.Lock()
"""Even a worker with several threads performs one run at a time, because settings apply to the whole process."""


@dataclass(frozen=True)
class Spec:
    """Specification of one run.

    toml: the arm's file with this run's values inserted, or "". versions: package versions that the worker must have.
    seconds: processor time after which the run counts as failed. recording: the run folder to estimate, or None.
    keep_in: where the run folder is kept; None if it is deleted.
    """

    run: int
    task: str
    toml: str
    varied: Mapping[str, Cell]
    columns: tuple[str, ...]
    seed: int = 1
    versions: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 3600.0
    recording: str | None = None
    keep_in: str | None = None


class WrongVersions(Exception):
    """A worker that joined later has different package versions from those with which the study was started."""


class OutOfTime(Exception):
    """A run took more processor time than engine.run_seconds allows."""


def work(spec: Spec) -> Row:
    """Perform one run and return its row. Raises only KeyboardInterrupt and SystemExit."""
    with _ONE_AT_A_TIME:
        row = _row_of(spec)
        began, used = time.perf_counter(), time.process_time()
        try:
            _check_versions(spec)
            with threadpool_limits(limits=1), _at_most(spec.seconds), _place(spec) as folder:
                row |= _result(spec, folder)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            row |= _failure(error) | {"where": f"{Path(last.filename).name}:{last.lineno}"}
        used = time.process_time() - used
        return row | {"seconds": time.perf_counter() - began, "cpu_seconds": used, "worker": os.getpid()}


def lost_row(spec: Spec, error: BaseException | None) -> Row:
    """Return the row of a run that returned no result because every worker that attempted it died."""
    why = RuntimeError("no worker finished it") if error is None else error
    if type(error).__name__ == "KilledWorker":
        why = MemoryError(
            "every worker that attempted this run died: the run crashes, or needs more memory than "
            "engine.worker_memory_gib"
        )
    return _row_of(spec) | _failure(why) | {"seconds": None, "cpu_seconds": None, "worker": None}


def _row_of(spec: Spec) -> Row:
    row: Row = {"run": spec.run, "task": spec.task, "status": "done", "message": "", "seed": spec.seed}
    row |= {f"vary.{key}": value for key, value in spec.varied.items()}
    return row | {"config_sha256": sha256(spec.toml.encode()).hexdigest()[:16], **spec.versions}


def _failure(error: BaseException) -> Row:
    lines = f"{type(error).__name__}: {error}".splitlines()
    return {"status": "failed", "message": lines[0][:500]}


def _check_versions(spec: Spec) -> None:
    here = versions() if spec.versions else {}
    other = [f"{name} {here.get(name)}, not {wanted}" for name, wanted in spec.versions.items() if here[name] != wanted]
    if other:
        raise WrongVersions(f"worker on {os.uname().nodename} has {'; '.join(other)}")


@contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    """Raise OutOfTime in this thread once the process has used this much processor time.

    No signal is used, because a worker does not perform runs in its main thread. Compiled code is not interrupted.
    """
    runner, over, limit = threading.get_ident(), threading.Event(), time.process_time() + seconds

    def watch() -> None:
        while not over.wait(min(1.0, max(0.01, limit - time.process_time()))):
            if time.process_time() > limit and not over.is_set():
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(runner), ctypes.py_object(OutOfTime))
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except OutOfTime:
        raise OutOfTime(f"took more than {seconds:g} s of processor time (engine.run_seconds)") from None
    finally:
        over.set()
        watcher.join()


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


def _result(spec: Spec, folder: Path) -> Row:
    """Return the requested columns. Raises whatever the run raises, with the folder's name removed from the message."""
    try:
        result = dict(flat(_done(spec, folder)))
    except Exception as error:
        error.args = tuple(_without(folder, each) for each in error.args)
        raise
    return {name: _without(folder, value) for name, value in result.items() if _kept(name, spec.columns)}


def _without(folder: Path, value: Any) -> Any:
    """Remove the folder's path from text, so that rows do not depend on where a worker performed the run."""
    return value.replace(f"{folder}/", "") if isinstance(value, str) else value


def _done(spec: Spec, folder: Path) -> Any:
    if spec.task == "empty":
        return {}
    if spec.task == "estimate":
        return _estimated(spec, folder)
    arm = folder / "arm.toml"
    arm.write_text(spec.toml, encoding="utf-8")
    shutil.rmtree(folder / "run", ignore_errors=True)  # of a worker that died on it
    return _on_arm(spec.task, arm, folder / "run")


@contextmanager
def _place(spec: Spec) -> Iterator[Path]:
    """The folder of a run, removed afterwards unless `spec.keep_in` names it; hil's user state is always removed."""
    with tempfile.TemporaryDirectory(prefix="hil-study-", dir=_scratch(), ignore_cleanup_errors=True) as scratch:
        folder = Path(spec.keep_in) if spec.keep_in else Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        kept = os.environ.get(_STATE)
        os.environ[_STATE] = str(Path(scratch) / "state")
        try:
            # The warnings of a thousand runs do not belong on the terminal.
            with redirect_stderr(io.StringIO()):
                yield folder
        finally:
            os.environ.pop(_STATE, None)
            if kept is not None:
                os.environ[_STATE] = kept


def _scratch() -> str | None:
    """The worker's own folder, which Dask removes even if the worker was killed."""
    from distributed import get_worker

    try:
        return str(get_worker().local_directory)
    except ValueError:
        return None  # not on a worker


def _on_arm(task: str, arm: Path, run: Path) -> Any:
    if task == "identify":
        from hil.api.experiment import identify

        return identify(arm, out=run).to_json()
    if task == "fault":
        from hil.study.injection import inject

        return inject(arm, run)
    return _dry_run(arm)


def _dry_run(arm: Path) -> Any:
    from hil.api.dry_run import dry_run

    return dry_run(arm).to_json()


def _estimated(spec: Spec, folder: Path) -> Any:
    """Estimate from a copy of the recording, so that the fleet's own folders are not modified."""
    from hil.estimation.settled_estimate import estimate_run
    from hil.runs.run_folder import RunFolder

    assert spec.recording is not None  # of this task
    source, copy = Path(spec.recording), folder / "run"
    copy.mkdir()
    for path in source.iterdir():
        if path.is_file() and path.name not in ("result.json", "report.html", "period.npz"):
            shutil.copy2(path, copy / path.name)
    run = RunFolder.open(copy)
    kind = ", ".join(each.model for each in run.load_config().joints)
    return {"recording": str(source), "arm_type": kind, **estimate_run(run).to_json()}
