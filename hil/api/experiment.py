"""`hil.identify` and `hil.record`: run an experiment on a real or fake arm."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from os import PathLike
from pathlib import Path

from hil.api.configuration import ConfigLike, loaded
from hil.api.progress import OnProgress, Progress, forgiving, ignore
from hil.api.run import Identification, Run, identification, load_run
from hil.clearance.doubts import doubts
from hil.config.schema import Config
from hil.drivers.errors import DriverError, TorqueNotOff
from hil.drivers.torque.held import HALF_DOWN
from hil.dry_run.ensemble import earlier_result
from hil.errors import ConfigError, ExperimentError, RunFolderError, SafetyStop, StopRequested
from hil.estimation.after_a_stop import after_a_failed_estimate, after_a_failure, after_a_stop, can_be_estimated
from hil.estimation.settled_estimate import estimate_run
from hil.estimator.errors import EstimationError
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress as StreamProgress
from hil.next_step import next_step
from hil.report.page import FILE_NAME, write_report
from hil.report.run_data import RunData
from hil.results.result import Result
from hil.runs.run_folder import RunFolder

__all__ = ["identify", "record"]

log = logging.getLogger(__name__)

_UNSETTLED = re.compile("TORQUE|restored|changed during|nother program")
"""If an error message matches this pattern, check the state of the servos before anything else."""


def identify(
    config: ConfigLike,
    *,
    out: str | PathLike[str] | None = None,
    take_over: bool = False,
    start_from: str | PathLike[str] | None = None,
    on_progress: OnProgress = ignore,
) -> Identification:
    """Excite the arm, record a settled period and estimate the arm's parameters (`hil identify` as a function).

    The arm moves. Torque is off when this function returns or raises.

    Args:
        config: TOML file of the arm, the name of a bundled one such as "fake_two_link", or a loaded configuration.
        out: run folder, which must be new or empty; by default runs/TIME-ARM.
        take_over: take over an arm that another program left with its torque on, and let it sink, braked by its
            motors, for at most 60 s; support it by hand.
        start_from: run folder or result.json of an earlier identification of the same arm. It replaces the prior,
            so that fewer runs are needed; requires experiment.pilot. If the arm does not move as that result predicts,
            the prior is used.
        on_progress: called with a `Progress` about 20 times a second while the arm moves; on a real bus, in a separate
            thread. It cannot disturb the experiment: reports that arrive too fast are dropped. If it raises, the
            exception is logged and the function is not called again; a KeyboardInterrupt stops the run.

    Returns:
        The result, with the run folder as `run`. The report is in that folder too.

    Raises:
        ConfigError: the configuration is wrong.
        RunFolderError: `out` is not empty or cannot be written.
        ExperimentError: the experiment could not be finished; the subclass says why, for example SafetyStop when a
            limit was exceeded.
        hil.drivers.errors.DriverError: the servos do not answer, or answer incorrectly.
        hil.estimator.errors.EstimationError: the recording does not determine the parameters.
    """
    checked, shown = loaded(config)
    if take_over:
        checked = _taking_over(checked)
    tell = forgiving(on_progress)
    earlier = None if start_from is None else _earlier(checked, shown, Path(start_from))
    run = new_run_folder(checked, shown, out)

    def watch(stream: StreamProgress) -> None:
        tell(Progress("experiment", stream=stream))

    def say(message: str) -> None:
        tell(Progress("experiment", message))

    with _discarding(run, "identify", shown):
        _tell_doubts(checked, tell)
        if checked.experiment.pilot:
            from hil.pilot import identify_in_steps

            torque, result = identify_in_steps(checked, run, shown, watch, say, earlier)
            say(torque)
        else:
            say(run_experiment(checked, run, shown, watch))
            tell(Progress("estimation", "Estimating"))
            result = estimate_run(run)
        write_run_report(run)
    log.info("%s: trust this model: %s", run.path, result.verdict.trust)
    return identification(result, run.path)


def record(
    config: ConfigLike,
    *,
    out: str | PathLike[str] | None = None,
    take_over: bool = False,
    on_progress: OnProgress = ignore,
) -> Run:
    """Run the experiment and store its recording for a later estimate (`hil record` as a function).

    The arm moves. Arguments and exceptions are as for `identify`.
    """
    checked, shown = loaded(config)
    if take_over:
        checked = _taking_over(checked)
    if checked.experiment.pilot:
        raise ConfigError(
            f"{shown}: with experiment.pilot = true, each step's torque depends on the previous step's estimate, which "
            "only `hil identify` makes. To record only, set experiment.peak_torque and pilot = false."
        )
    tell = forgiving(on_progress)
    run = new_run_folder(checked, shown, out)
    with _discarding(run, "record", shown):
        _tell_doubts(checked, tell)
        torque = run_experiment(checked, run, shown, lambda stream: tell(Progress("experiment", stream=stream)))
        tell(Progress("experiment", torque))
        return load_run(run.path)


def _earlier(config: Config, shown: Path, path: Path) -> Result:
    if config.is_chain or not config.experiment.pilot:
        why = "this arm is spatial" if config.is_chain else "this file gives peak_torque, so no pilot runs"
        raise ConfigError(
            f"{shown}: an earlier run can replace the prior only in a planar arm's pilot (experiment.pilot = true), "
            f"but {why}."
        )
    return earlier_result(config, path)


def _tell_doubts(config: Config, tell: OnProgress) -> None:
    for doubt in doubts(config):
        tell(Progress("experiment", f"Warning: {doubt}"))


def _how_to_go_on(stopped: BaseException, run: RunFolder, command: str, shown: Path) -> list[str]:
    if isinstance(stopped, KeyboardInterrupt | StopRequested | RunFolderError):
        said = after_a_stop(run, command, shown)
    elif isinstance(stopped, EstimationError) and can_be_estimated(run.path):
        said = after_a_failed_estimate(run)
    else:
        failed = isinstance(stopped, DriverError | EstimationError) or getattr(stopped, "exit_code", 0) == 1
        said = after_a_failure(run, shown) if failed else []
    if said and _is_unsettled(stopped):
        said[-1] = next_step("check", shown)
    elif said and _doubts_description(stopped):
        said[-1] = next_step("pose", shown, "--guide")
    return said


def _doubts_description(stopped: BaseException) -> bool:
    stop = stopped if isinstance(stopped, SafetyStop) else stopped.__context__
    return isinstance(stop, SafetyStop) and stop.doubts_description


def _is_unsettled(stopped: BaseException) -> bool:
    return bool(_UNSETTLED.search("\n".join([str(stopped), *getattr(stopped, "__notes__", [])])))


@contextmanager
def _discarding(run: RunFolder, command: str, shown: Path) -> Iterator[None]:
    """Remove the run folder if the experiment fails before the first sample, so that it does not block the next
    attempt. After a stop, add notes to the exception: what is kept and how to continue.
    """
    try:
        yield
    except BaseException as stopped:
        if not run.discard_if_unused():
            if isinstance(stopped, RunFolderError):
                stopped.exit_code = 1  # the disk became full, or the folder was lost: the input was valid
            with suppress(Exception):  # a failing hint must not hide what stopped the arm, or its torque state
                # If another program replaced the folder, the error says where the samples are.
                for line in _how_to_go_on(stopped, run, command, shown) if run.path.is_dir() else ():
                    stopped.add_note(line)
        elif any(HALF_DOWN in note for note in getattr(stopped, "__notes__", [])):
            stopped.add_note(next_step(command, shown, "--take-over"))
        elif isinstance(stopped, TorqueNotOff) or (
            hasattr(stopped, "__notes__")
            and (
                (isinstance(stopped, DriverError | ExperimentError) and not isinstance(stopped, StopRequested))
                or _is_unsettled(stopped)
            )
        ):
            stopped.add_note(next_step("check", shown))
        raise


def _taking_over(config: Config) -> Config:
    return config.model_copy(update={"safety": config.safety.model_copy(update={"take_over": True})})


def new_run_folder(config: Config, shown: Path, out: str | PathLike[str] | None) -> RunFolder:
    """The folder `out`, or a new one in runs/ named after the time and the arm. Raises RunFolderError."""
    path = unused_path(Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{shown.stem}") if out is None else Path(out)
    log.info("run folder %s", path)
    return RunFolder.create(path, config)


def unused_path(path: Path) -> Path:
    """Return `path`, with a number appended if it already exists, since a program can start two runs within a
    second.
    """
    number = 2
    tried = path
    while tried.exists():
        tried = path.with_name(f"{path.name}-{number}")
        number += 1
    return tried


def write_run_report(run: RunFolder) -> None:
    """Write the HTML report into the run folder."""
    write_report(RunData.load(run.path), run.path / FILE_NAME)
