"""The folder of a study. Only one process at a time works in it, and the study can be continued only with its original
inputs and versions.

DIR/study.toml   an exact copy of the study
DIR/about.json   number of runs, seed, versions, hashes of the arm's file and of the recordings
DIR/rows/        the rows (hil.study.dataset)
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from hil.errors import ConfigError, RunFolderError, not_written
from hil.runs.run_folder import write_json
from hil.study.dataset import Dataset
from hil.study.draw import arm_path, recordings
from hil.study.engine import versions
from hil.study.schema import Study


@contextmanager
def opened(study: Study, out: Path, runs: int, *, resume: bool) -> Iterator[Dataset]:
    """Open the dataset in `out`, which is new or belongs to the same study, and lock it for this process.

    Raises RunFolderError if the folder cannot be used, ConfigError if it holds another study, or this study with other
    inputs or versions.
    """
    copy, about = out / "study.toml", out / "about.json"
    text, now = study.path.read_bytes(), _about(study, runs)
    if resume and not copy.is_file():
        raise RunFolderError(f"{out} holds no study to resume.")
    try:
        (out / "rows").mkdir(parents=True, exist_ok=True)
        lock = os.open(out / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise not_written(out, error) from error
    try:
        _hold(lock, out)
        if copy.is_file():
            if not resume:
                raise RunFolderError(
                    f"{out} already holds a study: continue with --resume, or choose another folder with --out."
                )
            if copy.read_bytes() != text:
                raise ConfigError(
                    f"{study.path} is not the study that {out} holds ({copy} differs): it cannot be resumed."
                )
            _check_begun(out, _read(about), now)
        try:
            copy.write_bytes(text)
        except OSError as error:
            raise not_written(out, error) from error
        write_json(about, now)
        dataset = Dataset(out / "rows")
        try:
            yield dataset
        except BaseException:
            if not resume and not dataset.done():
                _discard(out)
            raise
    finally:
        os.close(lock)


def _discard(out: Path) -> None:
    """Remove the remains of a start that failed before its first row, so that they do not block the next one."""
    for name in ("study.toml", "about.json", ".lock"):
        (out / name).unlink(missing_ok=True)
    with suppress(OSError):  # other files are kept
        (out / "rows").rmdir()
        out.rmdir()


def _hold(lock: int, out: Path) -> None:
    """Lock the folder; the kernel releases the lock when this process ends, however it ends."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise RunFolderError(f"Another process is working on the study in {out}: wait for it, or stop it.") from error


def _about(study: Study, runs: int) -> dict[str, Any]:
    arm = b"" if study.study.config is None else arm_path(study).read_bytes()
    found = recordings(study) if study.study.task == "estimate" else []
    return {
        "schema": 1,
        "runs": runs,
        "seed": study.study.seed,
        "versions": versions(),
        "arm_sha256": sha256(arm).hexdigest(),
        "recordings_sha256": sha256("\n".join(map(str, found)).encode()).hexdigest(),
    }


def _read(about: Path) -> dict[str, Any]:
    try:
        found = json.loads(about.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}  # the process was killed before writing it: nothing has run yet
    return found if isinstance(found, dict) else {}


def _check_begun(out: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to mix rows of different arms, recordings or versions in one study."""
    if not then:
        return
    for key, what in (
        ("arm_sha256", "the arm's file has changed"),
        ("recordings_sha256", "the recordings have changed"),
    ):
        if then.get(key) != now[key]:
            raise ConfigError(
                f"The study in {out} cannot be resumed: {what} since it was started. Choose another folder with --out."
            )
    before = then.get("versions", {})
    other = [
        f"{name} {before.get(name)} (now {new})" for name, new in now["versions"].items() if before.get(name) != new
    ]
    if other:
        raise ConfigError(
            f"The study in {out} was started with {', '.join(other)}: use those versions, or choose another folder "
            "with --out."
        )
