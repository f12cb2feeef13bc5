"""`hil.estimate`: estimate parameters from a recording, without touching an arm."""

from collections.abc import Sequence
from concurrent.futures import Executor
from os import PathLike
from pathlib import Path

from hil.api.experiment import write_run_report
from hil.api.progress import OnProgress, Progress, ignore
from hil.api.run import Estimation, Identification, Run, estimation, identification
from hil.errors import ConfigError, RecordingCutShort
from hil.estimation.settled_estimate import estimate_run
from hil.estimation.unsettled.estimate import estimate_csv, estimate_unsettled
from hil.runs.run_folder import RunFolder

__all__ = ["estimate"]

PathLikeStr = str | PathLike[str]


def estimate(
    recording: PathLikeStr | Run | Sequence[PathLikeStr],
    *,
    config: PathLikeStr | None = None,
    all_samples: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress = ignore,
) -> Identification | Estimation:
    """Estimate an arm's parameters from a recording: `hil estimate` as a function.

    Args:
        recording: a run folder or a `Run`, whose result.json is rewritten; or one or more CSV files of one arm.
        config: for CSV files, the TOML file whose [columns] table describes them.
        all_samples: use every sample of the run, by multiple shooting; no settled period is needed.
        executor: of concurrent.futures, or `hil.study.engine.executor`; with `friction = "auto"` it begins fits that
            may be needed, for shorter waiting and more work in all. The result is the same with and without it.
        on_progress: called with a `Progress` when a new stage begins.

    Returns:
        An `Identification` from settled periods; an `Estimation` from CSV files, or with `all_samples`.

    Raises:
        RunFolderError: the folder holds no readable run.
        CsvError: a CSV file cannot be read as a recording.
        ConfigError: a CSV file was given without `config`, or `config` is wrong.
        RecordingCutShort: the run holds no settled period; `all_samples` does not need one.
        hil.estimator.errors.EstimationError: the recording does not determine the parameters.
        ValueError: `recording` mixes run folders and CSV files, or names several run folders.
    """
    if isinstance(recording, Run):
        paths = [recording.path]
    elif isinstance(recording, str | PathLike):
        paths = [Path(recording)]
    else:
        paths = [Path(each) for each in recording]
    if are_csv(paths):
        if config is None:
            raise ConfigError("A CSV file needs --config ARM.toml, whose [columns] table describes the columns.")
        on_progress(Progress("estimation", "Estimating by multiple shooting"))
        return estimation(estimate_csv(paths, Path(config)), None)
    run = RunFolder.open(paths[0])
    if all_samples:
        on_progress(Progress("estimation", "Estimating by multiple shooting"))
        return estimation(estimate_unsettled(run), run.path)
    on_progress(Progress("estimation", "Estimating"))
    try:
        result = estimate_run(run, executor)
    except RecordingCutShort as error:
        error.add_note(f"To estimate without a settled period: hil estimate {run.path} --all-samples")
        raise
    write_run_report(run)
    return identification(result, run.path)


def are_csv(paths: Sequence[Path]) -> bool:
    """Whether all paths are CSV files (true) or the only path is a run folder (false). Raises ValueError otherwise."""
    files = [path.suffix.lower() == ".csv" for path in paths]
    if any(files) and not all(files):
        raise ValueError("give either one run folder or CSV files, not both.")
    if not any(files) and len(paths) != 1:
        raise ValueError("one run folder at a time; only CSV files can be estimated together.")
    return all(files)
