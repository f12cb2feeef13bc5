"""`hil.estimate`: estimate parameters from a recording, without touching an arm."""

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from datetime import datetime
from os import PathLike
from pathlib import Path
from typing import Any

from hil.api.experiment import unused_path, write_run_report
from hil.api.progress import OnProgress, Progress, forgiving, ignore
from hil.api.run import Estimation, Identification, Run, estimation, identification
from hil.errors import RecordingCutShort
from hil.estimation.after_a_stop import after_a_failed_estimate
from hil.estimation.settled_estimate import estimate_run
from hil.estimation.unsettled.estimate import estimate_unsettled
from hil.estimation.unsettled.recordings import estimate_recordings
from hil.estimator.errors import EstimationError
from hil.recordings.files import is_recording
from hil.report.recording_page import write_recording_report
from hil.runs.recording_folder import create, is_recording_folder, load_record
from hil.runs.run_folder import RunFolder

__all__ = ["estimate"]

PathLikeStr = str | PathLike[str]


def estimate(
    recording: PathLikeStr | Run | Sequence[PathLikeStr],
    *,
    config: PathLikeStr | None = None,
    out: PathLikeStr | None = None,
    all_samples: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress = ignore,
) -> Identification | Estimation:
    """Estimate an arm's parameters from a recording (`hil estimate` as a function).

    Args:
        recording: a run folder or a `Run` (its result.json is rewritten), or one or more recordings of one arm made
            with other tools: CSV, Parquet or MCAP files, LeRobot datasets, ROS 2 bags.
        config: for recordings from other tools, a TOML file whose [columns] table describes them; without it, the
            columns must be recognisable by their names.
        out: for recordings from other tools, the folder for the result, which must be new or empty; by default
            runs/TIME-NAME.
        all_samples: use every sample of a run, by multiple shooting; no settled period is needed.
        executor: a concurrent.futures executor, or `hil.study.engine.executor`. With `friction = "auto"` it
            also runs fits in advance that may turn out not to be needed, which shortens the wait but increases the
            total work. It does not change the result.
        on_progress: called with a `Progress` when a new stage begins.

    Returns:
        An `Identification` from settled periods; an `Estimation` from other recordings, or with `all_samples`.

    Raises:
        RunFolderError: the folder holds no readable run.
        CsvError: a file cannot be read as a recording.
        ConfigError: `config` is wrong.
        RecordingCutShort: the run holds no settled period; `all_samples` does not need one.
        hil.estimator.errors.EstimationError: the recording does not determine the parameters.
        TypeError: an argument has the wrong type.
        ValueError: run folders and other recordings are mixed, or there are several run folders.
    """
    tell = forgiving(on_progress)
    paths = _paths(recording)
    _check_types(config, out, all_samples)
    if are_recordings(paths):
        tell(Progress("estimation", "Estimating by multiple shooting"))
        return _from_files(paths, None if config is None else Path(config), out)
    if is_recording_folder(paths[0]):
        tell(Progress("estimation", "Estimating by multiple shooting"))
        return _again(paths[0])
    run = RunFolder.open(paths[0])
    if all_samples:
        tell(Progress("estimation", "Estimating by multiple shooting"))
        return estimation(estimate_unsettled(run), run.path)
    tell(Progress("estimation", "Estimating"))
    try:
        result = estimate_run(run, executor)
    except (RecordingCutShort, EstimationError) as error:
        for line in after_a_failed_estimate(run):
            error.add_note(line)
        raise
    write_run_report(run)
    return identification(result, run.path)


def _paths(recording: Any) -> list[Path]:
    if isinstance(recording, Run):
        return [recording.path]
    try:
        return [Path(each) for each in ([recording] if isinstance(recording, str | PathLike) else recording)]
    except TypeError:
        raise TypeError(f"recording must be a run folder, a Run, or recordings, not {recording!r}.") from None


def _check_types(config: Any, out: Any, all_samples: Any) -> None:
    for name, value in (("config", config), ("out", out)):
        if not isinstance(value, str | PathLike | None):
            raise TypeError(f"{name} must be a path, not {value!r}.")
    if not isinstance(all_samples, bool):
        raise TypeError(f"all_samples must be True or False, not {all_samples!r}.")


def are_recordings(paths: Sequence[Path]) -> bool:
    """Whether the paths are recordings from other tools rather than one run folder. Raises ValueError for a mixture."""
    if not paths:
        raise ValueError("no recording is given: name a run folder, or recordings (CSV, Parquet, MCAP).")
    files = [is_recording(path) for path in paths]
    if any(files) and not all(files):
        raise ValueError("give either one run folder or recordings (CSV, Parquet, MCAP), not both.")
    if not any(files) and len(paths) != 1:
        raise ValueError("give one run folder at a time; only recordings from other tools can be estimated together.")
    return all(files)


def _from_files(paths: list[Path], config: Path | None, out: PathLikeStr | None) -> Estimation:
    name = config.stem if config is not None else paths[0].stem
    folder = unused_path(Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{name}") if out is None else Path(out)
    create(folder)
    with ExitStack() as unless_done:
        # A failed start leaves no folder that would block the next attempt.
        unless_done.callback(_discard, folder)
        found = estimate_recordings(paths, config, folder)
        write_recording_report(folder)
        unless_done.pop_all()
    return estimation(found, folder)


def _discard(folder: Path) -> None:
    """Remove a folder that holds no result. Do nothing if the folder does not exist."""
    if not (folder / "result.json").is_file():
        with suppress(FileNotFoundError):
            for path in folder.iterdir():
                path.unlink()
            folder.rmdir()


def _again(folder: Path) -> Estimation:
    """Repeat an earlier estimate of recordings with the configuration in `folder`, and write the result there."""
    record = load_record(folder)
    found = estimate_recordings([Path(file.path) for file in record.files], folder / "config.toml", folder)
    write_recording_report(folder)
    return estimation(found, folder)
