"""The JSON Schema of the TOML, from the models that check it: editors complete and check a file while it is typed.

It says what a single value or table must be like. What values must agree on (a rest pose within the position limits, as
many entries as joints) is checked only by `load_config`.
"""

import json
from typing import Any

from pydantic.json_schema import models_json_schema

from hil.config.csv_columns import Columns
from hil.config.schema import Config

__all__ = ["FILE_NAME", "schema_text", "toml_schema"]

FILE_NAME = "hil.schema.json"
_REF = "#/$defs/{model}"


def toml_schema() -> dict[str, Any]:
    """The schema of an arm's file. One without [port] describes a recording made elsewhere and needs [columns] only."""
    _, described = models_json_schema([(Config, "validation"), (Columns, "validation")], ref_template=_REF)
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
    """The schema as the file configs/hil.schema.json holds it."""
    return json.dumps(toml_schema(), indent=2, ensure_ascii=False) + "\n"


def _without_null(value: Any) -> Any:
    """TOML has no null: a key that may be None may only be omitted."""
    if isinstance(value, list):
        return [_without_null(each) for each in value]
    if not isinstance(value, dict):
        return value
    kept = {key: _without_null(each) for key, each in value.items() if not (key == "default" and each is None)}
    choices = [each for each in kept.pop("anyOf", []) if each != {"type": "null"}]
    if len(choices) == 1:
        return {**kept, **choices[0]}
    return {**kept, "anyOf": choices} if choices else kept
