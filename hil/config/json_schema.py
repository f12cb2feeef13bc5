"""The JSON Schema of the TOML file, generated from the models that check it.

Constraints between values are checked only by `load_config`.
"""

import json
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, models_json_schema

from hil.config.csv_columns import Columns
from hil.config.schema import Config

__all__ = ["FILE_NAME", "schema_text", "toml_schema"]

FILE_NAME = "hil.schema.json"
_REF = "#/$defs/{model}"


class _Untitled(GenerateJsonSchema):
    """Omits field titles, because pydantic's titles only repeat the keys and would make up a tenth of the file."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def toml_schema() -> dict[str, Any]:
    """The schema of an arm's file; without [port], the file describes a recording made elsewhere and needs only
    [columns].
    """
    _, described = models_json_schema(
        [(Config, "validation"), (Columns, "validation")], ref_template=_REF, schema_generator=_Untitled
    )
    defs = _without_null(described["$defs"])
    config = defs.pop("Config")
    tables = config["properties"]
    del tables["path"]
    tables["columns"] = {"$ref": "#/$defs/Columns"}
    for name, table in tables.items():
        table.setdefault("title", f"[{name}]")
    needed = [name for name in config["required"] if name != "path"]
    of_arm = defs["ArmConfig"].pop("required")
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "hil",
        "description": "An arm of Dynamixel servos, its limits and its experiment.",
        "type": "object",
        "additionalProperties": False,
        "properties": tables,
        "if": {"required": ["port"]},
        "then": {"required": needed, "properties": {"arm": {"required": of_arm}}},
        "else": {"required": ["columns"]},
        "$defs": defs,
    }


def schema_text() -> str:
    """The schema as text, as stored in configs/hil.schema.json."""
    return json.dumps(toml_schema(), indent=1, ensure_ascii=False) + "\n"


def _without_null(value: Any) -> Any:
    """Remove null alternatives: TOML has no null, so an optional key can only be omitted."""
    if isinstance(value, list):
        return [_without_null(each) for each in value]
    if not isinstance(value, dict):
        return value
    kept = {key: _without_null(each) for key, each in value.items() if not (key == "default" and each is None)}
    choices = [each for each in kept.pop("anyOf", []) if each != {"type": "null"}]
    if len(choices) == 1:
        return {**kept, **choices[0]}
    return {**kept, "anyOf": choices} if choices else kept
