"""Description of an arm that was recorded with other tools: the recording's columns, and some properties of the arm.

The TOML file of an experiment can be used, or a shorter one. Tables and keys that only an experiment needs are
ignored; unknown ones are errors.

    [arm]
    gravity = 9.81
    [model]
    friction = "stribeck"
    drive = "delay"
    [columns]
    position = ["pos_meas1", "pos_meas2"]
"""

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from hil.config.csv_columns import PLANAR, Columns
from hil.config.experiment import ModelConfig
from hil.config.joint import JointConfig
from hil.config.known_quantities import KnownConfig
from hil.config.schema import ArmConfig, Config
from hil.config.table import Table, Turned
from hil.errors import ConfigError
from hil.toml_errors import describe, fields_of
from hil.toml_file import TomlFileError, parse_toml, read_toml_text


class JointName(Table):
    """`[[joints]]`; only the name is used here, for arms with a URDF."""

    name: str | None = None


class ArmFacts(Table):
    """`[arm]`; only gravity and geometry are used here. The length of link 1 is compared with the estimate."""

    gravity: float = Field(9.81, ge=0, le=30, description="m/s^2 in the arm's plane")
    urdf: str | None = Field(None, description="URDF or MJCF of a spatial arm, relative to the TOML file")
    base: list[Turned] = Field(
        [0.0, 0.0, 0.0], min_length=3, max_length=3, description="with urdf: roll, pitch and yaw of the base, rad"
    )
    link_lengths: list[Annotated[float, Field(gt=0, le=3)]] | None = Field(
        None, description="m, from joint to joint and to the tip"
    )


class RecordingConfig(Table):
    """The tables of an arm's TOML file that apply to a recording made with other tools; all of them are optional."""

    columns: Columns = Columns()
    arm: ArmFacts = ArmFacts()
    model: ModelConfig = ModelConfig(friction="auto", drive="delay")
    known: KnownConfig | None = None
    joints: list[JointName] = Field([])

    @property
    def joint_names(self) -> tuple[str, ...] | None:
        """Names of the joints, from the base outwards; None unless every joint has a name."""
        names = tuple(joint.name for joint in self.joints if joint.name is not None)
        return names if names and len(names) == len(self.joints) else None

    @model_validator(mode="after")
    def _planar_without_urdf(self) -> Self:
        count = len(self.columns.position or ())
        if count > PLANAR and self.arm.urdf is None:
            raise ValueError(
                f"columns.position: {count} joints need arm.urdf, which gives the geometry, and a [[joints]] table "
                "with a name for each joint; without a URDF, an arm has one or two joints"
            )
        return self


def load_recording_config(path: Path) -> RecordingConfig:
    """Read and check the file; raises ConfigError."""
    try:
        text = read_toml_text(path)
    except TomlFileError as error:
        raise ConfigError(str(error)) from error
    return parse_recording_config(text, path)


def parse_recording_config(text: str, path: Path) -> RecordingConfig:
    """Check `text`, the contents of `path`; raises ConfigError."""
    try:
        values = parse_toml(text, path)
    except TomlFileError as error:
        raise ConfigError(str(error)) from error
    try:
        return RecordingConfig.model_validate(_relevant(_with_urdf_beside(values, path)))
    except ValidationError as error:
        raise ConfigError(describe(error, path, Config)) from error


def _relevant(values: dict[str, Any]) -> dict[str, Any]:
    """The values without the tables and keys that only an experiment needs; unknown tables and keys remain."""
    kept = _without(values, RecordingConfig, Config)
    if isinstance(kept.get("arm"), dict):
        kept["arm"] = _without(kept["arm"], ArmFacts, ArmConfig)
    if isinstance(joints := kept.get("joints"), list):
        kept["joints"] = [_without(each, JointName, JointConfig) if isinstance(each, dict) else each for each in joints]
    return kept


def _without(table: dict[str, Any], used: type[BaseModel], known: type[BaseModel]) -> dict[str, Any]:
    unused = {key for key, field in fields_of(known).items() if not field.exclude} - used.model_fields.keys()
    return {key: value for key, value in table.items() if key not in unused}


def _with_urdf_beside(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the tables, with a relative arm.urdf resolved against the TOML file's folder."""
    arm = values.get("arm")
    if isinstance(arm, dict) and isinstance(arm.get("urdf"), str):
        return {**values, "arm": {**arm, "urdf": str(path.parent / arm["urdf"])}}
    return values
