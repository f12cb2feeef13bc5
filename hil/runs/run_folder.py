"""The run folder: configuration (an exact copy), versions and machine, events, samples, result.

config.toml     copied byte for byte
experiment.json the [experiment] table as run, if hil chose it (pilot, torque found by dry runs)
stabiliser.json the [stabiliser] table as used, if hil chose it
run.json        versions, start time, and the data needed to interpret the samples
servo_settings.json  the servos' settings before the run (hil.setup.session.servo_session)
events.jsonl    events with their time, one JSON object per line, written as they happen
samples.npy     every sample (hil.runs.recording)
lateness.json   histogram of the samples' lateness (hil.runs.timing)
result.json     parameters with error bars, fit, validation, timing
period.npz      the settled periods as measured and as predicted (hil.runs.period_file)
"""

import json
import logging
import platform
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import cache
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from hil import __version__, strict_json
from hil.clearance.kept import keep_shapes
from hil.config.chain import described_arm
from hil.config.experiment import ExperimentConfig
from hil.config.schema import ArmConfig, Config, StabiliserConfig, parse_config
from hil.description.kept_file import kept_bytes
from hil.errors import ConfigError, RunFolderError, not_written
from hil.next_step import command, only_steps, steps_of
from hil.plan.plan import Plan
from hil.results.json_form import FormError, from_json, to_json
from hil.results.result import Result
from hil.toml_file import TomlFileError, read_toml_text
from hil.whole_file import replace_file

__all__ = ["SCHEMA", "Excitation", "RunFacts", "RunFolder", "RunRecord", "taken", "write_json"]

log = logging.getLogger(__name__)

SCHEMA = 1
_PACKAGES = ("numpy", "scipy", "numba", "pyserial", "dynamixel-sdk")


def taken(path: Path) -> RunFolderError:
    """Return the error for a folder that is not empty; its message suggests an unused name."""
    free = next(found for number in count(2) if not (found := path.with_name(f"{path.name}-{number}")).exists())
    return RunFolderError(
        f"Run folder {path} is not empty; choose another (--out, or out= in Python), for example {free}, or remove it."
    )


@dataclass(frozen=True)
class RunFacts:
    """What `estimate` needs besides configuration and samples.

    config: path of the configuration, as the user wrote it. command_to_sample: time from the arrival of the goal
    currents at the servos to the sampling of their positions [s]. position_step: encoder step of each joint [rad].
    segments: role of each multisine, in the order of the experiment. monitoring: a warning about what could not be
    monitored closely; "" if there is none.
    """

    config: str
    command_to_sample: float
    position_step: Sequence[float]
    segments: Sequence[str]
    monitoring: str = field(default="", kw_only=True)


@dataclass(frozen=True)
class Excitation:
    """One multisine of the experiment: its role, and the excited harmonics and crest factor of each joint."""

    role: str
    lines: tuple[tuple[int, ...], ...]
    crest_factor: tuple[float, ...]


@dataclass(frozen=True)
class RunRecord(RunFacts):
    """The contents of run.json: `RunFacts`, versions and machine. started: ISO 8601 with the offset from UTC."""

    started: str
    versions: Mapping[str, str]
    python: str
    machine: str
    excitation: Sequence[Excitation]


Facts = TypeVar("Facts", bound=RunFacts)


_OF_A_START = frozenset(
    {
        "config.toml",
        "experiment.json",
        "stabiliser.json",
        "rest_pose.json",
        "starts.json",
        "run.json",
        "events.jsonl",
        "samples.npy",
        "servo_settings.json",
    }
)
_DESCRIPTIONS = (".urdf", ".xml", ".shapes.json")


class RunFolder:
    """The folder of one run. `create` makes a new one, `open` reads an existing one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._written: list[Path] = []
        """Files written before the recording begins; without them, it could not be used."""

    @classmethod
    def create(cls, path: Path, config: Config) -> "RunFolder":
        """Create the folder and copy the configuration. Raises RunFolderError if the folder is not empty or not
        writable.
        """
        run = cls(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                raise taken(path)
            run.config_path.write_bytes(config.path.read_bytes())
            for urdf in _urdfs(config):
                (path / urdf.name).write_bytes(kept_bytes(urdf))
            if config.is_chain:
                keep_shapes(described_arm(config), path)
            run._written += path.iterdir()
        except OSError as error:
            raise not_written(path, error, "Run folder") from error
        return run

    def refuse_lost(self) -> None:
        """Raise RunFolderError if the folder has been removed, renamed or emptied since it was created.

        If servo settings or facts of the run have been written in the meantime, the folder exists again, but lacks the
        configuration.
        """
        if gone := [each.name for each in self._written if not each.is_file()]:
            lost = RunFolderError(
                f"Run folder {self.path} was removed or renamed while the run was being prepared: {gone[0]} is no "
                "longer there. Torque was not switched on for this run, and nothing of it has been recorded. Start "
                "again, and leave the folder in place until the command ends."
            )
            lost.exit_code = 1  # the input was valid
            raise lost

    def discard_if_unused(self) -> bool:
        """Remove the folder if the experiment failed before the first sample. Returns whether it was removed.

        The same --out can then be used again. A folder with a sample, a result or a foreign file is kept.
        """
        try:
            files = [path for path in self.path.rglob("*") if path.is_file()]
        except OSError:  # too many open files
            return False
        if any(path.name not in _OF_A_START and not path.name.endswith(_DESCRIPTIONS) for path in files):
            return False
        if any(path.name == "samples.npy" and _has_samples(path) for path in files):
            return False
        shutil.rmtree(self.path, ignore_errors=True)
        return not self.path.exists()

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open the folder of a run. Raises RunFolderError."""
        run = cls(path)
        if path.is_file():
            raise RunFolderError(
                f"{path} is a file: give the folder of a run. To read a recording, hil estimate needs a CSV, Parquet "
                "or MCAP file, or a ROS 2 bag."
            )
        if (path / "recordings.npz").is_file():
            raise RunFolderError(
                f"{path} is an estimate from another tool's recordings, but a run of hil identify or hil record "
                "is needed here. hil.load_model and hil export accept an estimate, too."
            )
        if steps := steps_of(path):
            raise RunFolderError(only_steps(path, steps))
        for needed in (run.config_path, run.run_path, run.samples_path):
            if needed.is_symlink() and not needed.exists():
                raise RunFolderError(f"{needed} is a broken link.")
            if not needed.is_file():
                raise RunFolderError(
                    f"{path} is not a run folder: it has no {needed.name}. To list existing runs: {command('runs')}"
                )
        return run

    @property
    def config_path(self) -> Path:
        return self.path / "config.toml"

    def own_files(self) -> frozenset[str]:
        """Names of all files that belong to the run, including those of its estimate and of the arm's description."""
        own = _OF_A_START | {"result.json", "lateness.json", "recordings.npz"}
        with suppress(RunFolderError, ConfigError):
            own |= {urdf.name for urdf in _urdfs(self.load_config())}
        return own | {path.name for path in self.path.glob("*.shapes.json")}

    @property
    def run_path(self) -> Path:
        return self.path / "run.json"

    @property
    def samples_path(self) -> Path:
        return self.path / "samples.npy"

    @property
    def result_path(self) -> Path:
        return self.path / "result.json"

    @property
    def played_path(self) -> Path:
        return self.path / "experiment.json"

    @property
    def stabiliser_path(self) -> Path:
        return self.path / "stabiliser.json"

    def load_config(self) -> Config:
        """The configuration, with the experiment that was actually run. Raises ConfigError, RunFolderError."""
        try:
            text = read_toml_text(self.config_path)
        except TomlFileError as error:
            raise RunFolderError(str(error)) from error
        config = parse_config(text, self.config_path, recorded=True)
        if not self.played_path.is_file():
            return config
        played: dict[str, Any] = {}
        try:
            played["experiment"] = ExperimentConfig(**_read_json(self.played_path))
            if self.stabiliser_path.is_file():
                played["stabiliser"] = StabiliserConfig(**_read_json(self.stabiliser_path))
            if self.rest_pose_path.is_file():
                played["arm"] = ArmConfig(**{**config.arm.model_dump(), **_read_json(self.rest_pose_path)})
        except ValidationError as error:
            raise RunFolderError(f"The excitation stored next to {self.config_path} is damaged: {error}.") from error
        return config.model_copy(update=played)

    def below(self, name: str, played: Config) -> "RunFolder":
        """Create a separate run with the configuration `played` in the subfolder `name`. Raises RunFolderError."""
        folder = RunFolder.create(self.path / name, played)
        folder.write_played(played)
        return folder

    @property
    def rest_pose_path(self) -> Path:
        return self.path / "rest_pose.json"

    @property
    def starts_path(self) -> Path:
        return self.path / "starts.json"

    def write_starts(self, starts: list[dict[str, float]]) -> None:
        """Save initial guesses (parameters by name [SI]) for this and any later estimate."""
        write_json(self.starts_path, {"starts": starts})

    def load_starts(self) -> list[dict[str, float]]:
        """The saved initial guesses, if any. Raises RunFolderError."""
        if not self.starts_path.is_file():
            return []
        starts = _read_json(self.starts_path).get("starts")
        if not isinstance(starts, list):
            raise RunFolderError(f"{self.starts_path} is damaged: it has no list of initial guesses.")
        return starts

    def write_played(self, played: Config) -> None:
        """Save the [experiment] and [stabiliser] tables actually used, if they differ from the file (pilot, computed
        torque or gains), and the rest pose of a spatial arm.
        """
        tables = {self.played_path: played.experiment.model_dump()}
        if played.stabiliser is not None:
            tables[self.stabiliser_path] = played.stabiliser.model_dump()
        if played.is_chain:
            tables[self.rest_pose_path] = {"rest_pose": list(played.arm.rest_pose)}
        for path, table in tables.items():
            write_json(path, table)
            self._written.append(path)

    def set_aside(self, name: str, played: Config) -> None:
        """Move the run's recording to the subfolder `name`, so that another run can use this folder. played: the
        configuration with which it was recorded.
        """
        folder = self.below(name, played)
        try:
            for path in (self.samples_path, self.run_path, self.path / "lateness.json"):
                if path.is_file():
                    path.replace(folder.path / path.name)
        except OSError as error:
            raise not_written(folder.path, error) from error

    def write_facts(self, facts: RunFacts, plan: Plan) -> None:
        """Write run.json: `facts`, versions and machine."""
        record = RunRecord(
            **{each.name: getattr(facts, each.name) for each in fields(RunFacts)},
            started=datetime.now().astimezone().isoformat(timespec="seconds"),
            versions={"hil": __version__, **_versions()},
            python=platform.python_version(),
            machine=platform.platform(),
            excitation=[
                Excitation(
                    segment.role,
                    tuple(tuple(map(int, lines)) for lines in segment.multisine.lines),
                    tuple(round(float(value), 4) for value in segment.multisine.crest_factor),
                )
                for segment in plan.segments
            ],
        )
        write_json(self.run_path, {"schema": SCHEMA, **to_json(record)})

    def load_facts(self) -> RunFacts:
        """The part of run.json that an estimate needs. Raises RunFolderError."""
        return self._load_run(RunFacts)

    def load_record(self) -> RunRecord:
        """All of run.json. Raises RunFolderError."""
        return self._load_run(RunRecord)

    def _load_run(self, kind: type[Facts]) -> Facts:
        values = _read_json(self.run_path)
        if values.get("schema") != SCHEMA:
            raise RunFolderError(
                f"{self.run_path}: schema is {values.get('schema')!r}, not {SCHEMA}; this run was made by another "
                "version of hil."
            )
        try:
            return from_json(kind, values)
        except FormError as error:
            raise RunFolderError(f"{self.run_path} is damaged: it {error}.") from error

    def event(self, time: float, what: str) -> None:
        """Append one event with its time on the port's clock [s]. Raises RunFolderError."""
        log.info("%.3f s: %s", time, what)
        line = json.dumps({"time": round(time, 6), "event": what}, ensure_ascii=False)
        path = self.path / "events.jsonl"
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise not_written(path, error) from error

    def load_events(self) -> tuple[tuple[float, str], ...]:
        """The events as (time on the port's clock [s], what happened); a last line cut short by a crash is ignored.

        Raises RunFolderError.
        """
        path = self.path / "events.jsonl"
        if not path.is_file():
            return ()
        try:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise RunFolderError(f"{path} cannot be read: {error}.") from error
        found = []
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                found.append((float(entry["time"]), str(entry["event"])))
            except (ValueError, KeyError, TypeError) as error:
                if number < len(lines):
                    raise RunFolderError(f"{path} is damaged on line {number}: {line[:60]!r}.") from error
        return tuple(found)

    def write_result(self, result: Result) -> None:
        """Write result.json. Raises RunFolderError."""
        write_json(self.result_path, result.to_json())


def _urdfs(config: Config) -> set[Path]:
    """URDF files that the configuration names. A copy of the configuration expects them in its own folder."""
    chain = None if config.fake is None else config.fake.chain
    named = [config.arm.urdf, None if chain is None else chain.urdf]
    return {Path(each) for each in named if each is not None}


def _has_samples(path: Path) -> bool:
    """Whether the file holds any recorded sample; also true if the file cannot be read."""
    from hil.runs.recording import Phase

    try:
        phases = np.load(path, allow_pickle=False, mmap_mode="r")["phase"]
    except (OSError, ValueError, IndexError, EOFError):
        return True
    return bool((phases != Phase.NOT_RECORDED).any())


@cache
def _versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on. Reading the versions takes as long as 100 bus
    exchanges.
    """
    return {name: version(name) for name in _PACKAGES}


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON file completely or not at all. Raises RunFolderError."""
    replace_file(path, strict_json.dumps(value, indent=2) + "\n")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RunFolderError(f"{path} cannot be read: {error}.") from error
    if not isinstance(value, dict):
        raise RunFolderError(f"{path} is damaged: it is not a JSON object.")
    return value
