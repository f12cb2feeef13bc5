"""STUDY.toml: what to vary, run and record, and on which workers.

[study]
task = "identify"                    # identify, dry_run, fault, estimate, empty
config = "fake_two_link"             # an arm's TOML, or a bundled one
runs = 200                           # rows; default: every combination of the lists in [vary]
seed = 1

[vary]                               # keys of the arm's TOML, list entries by number
"fake.seed" = { count = 1000 }       # 1000 plus the run's number
"experiment.seed" = [1, 2, 3]
"fake.arm.drives.0.coulomb" = { log_uniform = [0.02, 0.1] }
"fake.arm.links.1.mass" = { normal = [0.2, 0.02] }

[keep]
columns = ["verdict.trust", "parameters.*.value"]
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    PositiveFloat,
    Tag,
    ValidationError,
    model_validator,
)

from hil.errors import ConfigError
from hil.toml_errors import UNSAID, describe
from hil.toml_file import TomlFileError, load_toml

Task = Literal["identify", "dry_run", "fault", "estimate", "empty"]
ON_ARM: tuple[Task, ...] = ("identify", "dry_run", "fault")
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


def _scalar(value: Any) -> bool | int | float | str:
    if isinstance(value, bool | int | float | str):
        return value
    raise ValueError("must be a number, text in quotes, true or false")


Scalar = Annotated[bool | int | float | str, PlainValidator(_scalar)]

MOST_RUNS = 10_000_000


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Draw(_Table):
    """A distribution to draw from; exactly one field must be given."""

    uniform: Pair | None = Field(None, description="[low, high]")
    log_uniform: Pair | None = Field(None, description="[low, high], both positive")
    normal: Pair | None = Field(None, description="[mean, standard deviation]")
    integer: list[int] | None = Field(None, min_length=2, max_length=2, description="[low, high], both included")
    choice: list[Scalar] | None = Field(None, min_length=1, description="values, one of which is drawn")
    count: int | None = Field(None, description="this number plus the number of the run")

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(type(self).model_fields)}, not {len(given)}")
        for name in ("uniform", "log_uniform", "integer"):
            bounds = getattr(self, name)
            if bounds is not None and not bounds[0] <= bounds[1]:
                raise ValueError(f"{name} = {bounds}: the first must not be larger than the second")
        if self.log_uniform is not None and self.log_uniform[0] <= 0:
            raise ValueError(f"log_uniform = {self.log_uniform}: both must be positive")
        if self.normal is not None and self.normal[1] < 0:
            raise ValueError(f"normal = {self.normal}: the standard deviation must not be negative")
        return self


class StudyTable(_Table):
    """`[study]`: the task, its input, and the number of runs."""

    task: Task = Field(description="what one run does")
    config: str | None = Field(None, min_length=1, description="the arm's TOML or a bundled arm's name")
    recordings: str | None = Field(
        None, min_length=1, description="for estimate: the folder that holds the run folders"
    )
    runs: int | None = Field(
        None, ge=1, le=MOST_RUNS, description="number of rows; default: every combination of the lists"
    )
    seed: int = Field(1, ge=0, description="seed of all draws")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.task in ON_ARM and self.config is None:
            raise ValueError(f'task = "{self.task}" needs config = "ARM.toml"')
        if (self.task == "estimate") != (self.recordings is not None):
            raise ValueError('task = "estimate" needs recordings = "FOLDER"; no other task takes recordings')
        if self.task == "estimate" and (self.config is not None or self.runs is not None):
            raise ValueError('task = "estimate" takes the recordings as they are: omit config and runs')
        return self


class KeepTable(_Table):
    """`[keep]`: what is recorded about each run."""

    columns: list[str] | None = Field(
        None, min_length=1, description="column names, with * as wildcard; default: those of the task"
    )
    run_folders: bool = Field(False, description="also keep the run folders, with recordings and reports")


class EngineTable(_Table):
    """`[engine]`: the workers, unless given on the command line."""

    workers: int | None = Field(None, ge=1, le=4096, description="number of worker processes; default: one per core")
    worker_memory_gib: PositiveFloat = Field(
        2.0, le=1024, description="memory of each worker; one that needs more is restarted"
    )
    run_seconds: PositiveFloat = Field(3600.0, description="processor time after which a run counts as failed")


def _values(value: Any) -> Any:
    if isinstance(value, list | dict | Draw):
        return value
    raise ValueError("must be a list of values or a draw such as { uniform = [0.1, 0.2] }")


def _list_or_draw(value: Any) -> str:
    return f"{UNSAID}list" if isinstance(value, list) else f"{UNSAID}draw"


Varied = Annotated[
    Annotated[list[Scalar], Tag(f"{UNSAID}list")] | Annotated[Draw, Tag(f"{UNSAID}draw")],
    Discriminator(_list_or_draw),
    BeforeValidator(_values),
]


class Study(_Table):
    """The complete study. `path` is the file it was read from."""

    path: Path = Field(exclude=True)
    study: StudyTable
    vary: dict[str, Varied] = {}
    keep: KeepTable = KeepTable()
    engine: EngineTable = EngineTable()

    @model_validator(mode="after")
    def _varied(self) -> Self:
        for key, values in self.vary.items():
            if isinstance(values, list) and not values:
                raise ValueError(f'vary."{key}" is an empty list')
        if self.vary and self.study.task == "estimate":
            raise ValueError("[vary] does not apply to existing recordings: omit it")
        if self.study.runs is None and self.study.task != "estimate":
            drawn = [key for key, values in self.vary.items() if isinstance(values, Draw)]
            if drawn:
                raise ValueError(f'study.runs is missing: vary."{drawn[0]}" is drawn at random, so runs must be given')
        return self


def load_study(path: Path) -> Study:
    """Read and check the file. Raises ConfigError; its message gives the file, key, value and allowed values."""
    try:
        values = load_toml(path)
    except TomlFileError as error:
        raise ConfigError(str(error)) from error
    if "path" in values:
        raise ConfigError(f"{path}: path is not a known key.")
    if "study" not in values and "joints" in values:
        raise ConfigError(
            f"{path} describes an arm, not a study. A study is a separate file with a [study] table that names "
            "the arm's file: see docs/scale.md."
        )
    try:
        return Study(path=path, **values)
    except ValidationError as error:
        raise ConfigError(describe(error, path, Study)) from error
