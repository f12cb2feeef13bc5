"""What remains of a run that was stopped or yielded no result, and the command with which to continue."""

from pathlib import Path

from hil.errors import HilError
from hil.estimation.settled_period import settled_period
from hil.estimator.errors import EstimationError
from hil.next_step import next_step
from hil.plan.plan import IDENTIFY
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder


def after_a_stop(run: RunFolder, command: str, shown: Path) -> list[str]:
    """Sentences about what remains of a stopped run; the last one names the next command.

    command: the subcommand that was stopped. shown: the configuration's path as the user wrote it.
    """
    if nothing := _nothing_recorded(run, shown):
        return nothing
    if run.result_path.is_file():
        return ["The result is kept; the report is missing.", next_step("report", run.path)]
    if can_be_estimated(run.path):
        return ["The recording has been kept and is complete enough for an estimate.", next_step("estimate", run.path)]
    steps = [step for step in _steps(run.path) if can_be_estimated(step)]
    if steps:
        return [
            f"The recording of {steps[-1].name} is kept; its motion was smaller than the limits allow. An estimate "
            "from it would be less accurate than one from a finished run.",
            next_step("estimate", steps[-1]),
        ]
    return [f"The recording up to that point is kept in {run.path}; no period had settled.", next_step(command, shown)]


def after_a_failure(run: RunFolder, shown: Path) -> list[str]:
    """Sentences about what remains of a run that the guard or a failed servo stopped; the last one names the next
    command.
    """
    if nothing := _nothing_recorded(run, shown):
        return nothing
    if can_be_estimated(run.path):
        return ["The recording has been kept and is complete enough for an estimate.", next_step("estimate", run.path)]
    return [f"The recording up to that point is kept in {run.path}.", next_step("check", shown)]


def after_a_failed_estimate(run: RunFolder) -> list[str]:
    """Sentences about a recording with a settled period from which no parameters could be estimated, and the next
    command.
    """
    kept = f"The recording is kept in {run.path}."
    if run.load_config().is_chain:
        return [kept, next_step("check", run.load_facts().config)]
    return [
        f"{kept} An estimate from all of its samples needs no settled period.",
        next_step("estimate", run.path, "--all-samples"),
    ]


def _nothing_recorded(run: RunFolder, shown: Path) -> list[str]:
    """Sentences about a folder without data that could not be removed; [] if it holds a recording or a result."""
    # Without free file descriptors, no folder can be searched.
    if run.result_path.is_file() or run.samples_path.is_file() or any(run.path.rglob(run.samples_path.name)):
        return []
    return [
        f"Nothing was recorded, but {run.path} could not be removed: check that its disk is writable.",
        next_step("check", shown),
    ]


def can_be_estimated(path: Path) -> bool:
    """Whether a folder holds a settled period of the motion to be fitted."""
    try:
        run = RunFolder.open(path)
        config, facts = run.load_config(), run.load_facts()
        if IDENTIFY not in facts.segments:
            return False
        settled_period(config, facts, load_samples(run.samples_path, len(config.joints)), IDENTIFY)
    except (HilError, EstimationError, ValueError):
        return False
    return True


def _steps(path: Path) -> list[Path]:
    """Folders of the runs that preceded the final one, oldest first."""
    found = [each.parent for each in path.glob("*/samples.npy")]
    return sorted(found, key=lambda folder: (folder / "samples.npy").stat().st_mtime)
