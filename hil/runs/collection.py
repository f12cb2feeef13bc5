"""A collection of run folders: arm, date, outcome, name and note of each run.

Name and note are stored in note.json in the run's own folder, so that they move with it.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from os import PathLike
from pathlib import Path
from typing import Any

from hil.errors import ResultError, RunFolderError
from hil.model_file import read_result
from hil.next_step import command, only_steps, steps_of
from hil.runs.run_folder import write_json

NOTE_FILE = "note.json"
_LONGEST = 2000


@dataclass(frozen=True)
class Note:
    """A user's name and note for a run."""

    name: str = ""
    text: str = ""


@dataclass(frozen=True)
class RunSummary:
    """Summary of one run.

    started: None if run.json does not contain it. verdict: "yes", "with care", "no", or what is missing. residual:
    that of the worst joint in encoder steps; None without a result. steps: number of pilot and intermediate runs in
    the run folder.
    """

    path: Path
    arm: str
    started: datetime | None
    verdict: str
    residual: float | None
    steps: int
    note: Note

    def to_json(self) -> dict[str, Any]:
        """The summary as plain values; `started` in ISO 8601."""
        started = self.started.isoformat() if self.started else None
        return asdict(self) | {"path": str(self.path), "started": started}


def find_runs(folder: str | PathLike[str]) -> list[RunSummary]:
    """The runs in `folder`, or `folder` itself if it is a run, oldest first; pilot steps count as part of their run.

    Raises RunFolderError if the folder does not exist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RunFolderError(
            f"{folder} is not a folder. `hil identify` creates its runs in runs/ in the current folder."
        )
    found = [summarise(path) for path in _run_folders(folder)]
    return sorted(found, key=lambda run: (run.started.timestamp() if run.started else 0.0, str(run.path)))


def summarise(path: Path) -> RunSummary:
    """Summarise one run folder. Damaged files do not raise an exception; the summary mentions them."""
    facts = _facts(path)
    arm = Path(str(facts.get("config", ""))).stem or path.name
    verdict, residual = _outcome(path)
    try:
        note = read_note(path)
    except RunFolderError:
        note = Note(text="(note.json is damaged)")
    steps = sum(1 for below in path.iterdir() if _is_run(below))
    return RunSummary(path, arm, _started(facts), verdict, residual, steps, note)


def read_note(path: Path) -> Note:
    """The note of a run, empty if there is none. Raises RunFolderError if it is damaged, or if there is no run."""
    if not _is_run(path):
        raise _no_run(path)
    file = path / NOTE_FILE
    if not file.is_file():
        return Note()
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        return Note(str(values.get("name", "")), str(values.get("text", "")))
    except (OSError, ValueError, AttributeError) as error:
        raise RunFolderError(f"{file} cannot be read: {error}. Write it again with hil note.") from error


def _no_run(path: Path) -> RunFolderError:
    if path.is_dir() and (steps := steps_of(path)):
        return RunFolderError(only_steps(path, steps))
    return RunFolderError(
        f"{path} is not a run folder: it has neither run.json nor samples.npy. To list existing runs: {command('runs')}"
    )


def write_note(path: Path, note: Note) -> None:
    """Store a name and a note with the run. Raises RunFolderError."""
    if not _is_run(path):
        raise _no_run(path)
    if len(note.name) > _LONGEST or len(note.text) > _LONGEST:
        raise RunFolderError(f"A name or note may have at most {_LONGEST} characters.")
    for key, value in asdict(note).items():
        if not value.isprintable():
            raise RunFolderError(
                f"--{key} {value!a} must not contain line breaks, tabs or other unprintable characters."
            )
    write_json(path / NOTE_FILE, asdict(note))


def _run_folders(folder: Path) -> Iterator[Path]:
    if _is_run(folder):
        yield folder
        return
    for below in sorted(folder.iterdir()):
        if below.is_dir() and not below.is_symlink():
            yield from _run_folders(below) if not _is_run(below) else [below]


def _is_run(path: Path) -> bool:
    return path.is_dir() and ((path / "run.json").is_file() or (path / "samples.npy").is_file())


def _facts(path: Path) -> dict[str, Any]:
    try:
        facts = json.loads((path / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _started(facts: dict[str, Any]) -> datetime | None:
    try:
        return datetime.fromisoformat(str(facts["started"])).astimezone()
    except (KeyError, ValueError):
        return None


def _outcome(path: Path) -> tuple[str, float | None]:
    """Verdict and worst residual; if there is no result, the reason and None."""
    if not (path / "result.json").is_file():
        return "not estimated" if (path / "samples.npy").is_file() else "not finished", None
    try:
        result = read_result(path)
    except ResultError:
        return "result.json is damaged", None
    if not all(math.isfinite(value) for value in result.values.values()):
        return "result.json is damaged", None
    verdict = "no verdict" if result.verdict is None else result.verdict.trust
    return verdict, max(result.fit.residual_rms_ticks, default=None)
