"""Description of a recording made elsewhere: its columns, their units, and a few facts about the arm.

The TOML file of an experiment can be used, or a shorter one; tables that only the bus needs are ignored.

    [arm]
    gravity = 9.81
    [model]
    friction = "stribeck"
    drive = "delay"
    [columns]
    time = "time"                                     # in seconds unless time_unit is given
    position = ["pos_meas1", "pos_meas2"]             # one per joint
    torque = ["tau_meas1", "tau_meas2"]               # or current, which needs torque_constant
    position_unit = "rad"                             # rad, deg, turns
    zero = [-1.5707963, 0.0]                          # rad added to the column: joint 1 from the horizontal
"""

import tomllib
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError, model_validator

from hil.config.experiment import ModelConfig
from hil.config.known_quantities import KnownConfig
from hil.errors import ConfigError
from hil.toml_errors import describe

Column = Annotated[str, Field(min_length=1)]
POSITION_UNITS = {"rad": 1.0, "deg": 0.017453292519943295, "turns": 6.283185307179586}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
TORQUE_UNITS = {"N m": 1.0, "mN m": 1e-3}
CURRENT_UNITS = {"A": 1.0, "mA": 1e-3}


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Columns(_Table):
    """`[columns]`: the meaning and unit of each column."""

    time: Column = "time"
    time_unit: Literal["s", "ms", "us"] = "s"
    position: list[Column] = Field(min_length=1, max_length=2, description="one column per joint")
    position_unit: Literal["rad", "deg", "turns"] = "rad"
    zero: list[float] | None = Field(
        None, description="rad added to each position, so that joint 1 is measured from the horizontal"
    )
    position_step: PositiveFloat | None = Field(
        None, description="rad per encoder step; detected from the data if absent"
    )
    torque: list[Column] | None = Field(None, description="one column per joint")
    torque_unit: Literal["N m", "mN m"] = "N m"
    current: list[Column] | None = Field(None, description="one column per joint, in place of torque")
    current_unit: Literal["A", "mA"] = "A"
    torque_constant: list[PositiveFloat] | None = Field(None, description="N m/A per joint, with current")
    between: Literal["held", "linear"] = Field("linear", description="held for a command, linear for a measurement")
    segment: PositiveFloat = Field(1.0, le=60, description="s per shooting segment, each with an unknown initial state")
    zeros_unknown: bool = Field(True, description="estimate each encoder's zero offset")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.position)
        if (self.torque is None) == (self.current is None):
            raise ValueError("columns: give either torque or current, one column per joint")
        if self.current is not None and self.torque_constant is None:
            raise ValueError("columns.torque_constant is missing: current needs it, N m/A per joint")
        for key in ("torque", "current", "torque_constant", "zero"):
            values = getattr(self, key)
            if values is not None and len(values) != count:
                raise ValueError(f"columns.{key} has {len(values)} entries; position has {count}, one per joint")
        return self


class ArmFacts(BaseModel):
    """`[arm]`; only gravity is used here."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    gravity: float = Field(9.81, ge=0, le=30, description="m/s^2 in the arm's plane")


class CsvConfig(BaseModel):
    """The tables of an arm's TOML file that are needed for a recording made elsewhere."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    columns: Columns
    arm: ArmFacts = ArmFacts()
    model: ModelConfig = ModelConfig(friction="stribeck", drive="delay")
    known: KnownConfig | None = None


def load_csv_config(path: Path) -> CsvConfig:
    """Read and check the TOML file. Raises ConfigError."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8 text'}.") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}.") from error
    if "columns" not in values:
        raise ConfigError(
            f"{path}: has no [columns] table, which describes the CSV columns. Example:\n[columns]\n"
            'time = "time"\nposition = ["q1", "q2"]\ntorque = ["tau1", "tau2"]'
        )
    try:
        return CsvConfig.model_validate(values)
    except ValidationError as error:
        raise ConfigError(describe(error, path, CsvConfig)) from error
