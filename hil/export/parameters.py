"""TOML and JSON export of the identified parameters; `hil.load_model` reads both without loss of precision."""

import json
from pathlib import Path
from typing import Any

from hil import strict_json
from hil.export.source import Source
from hil.whole_file import write_whole

_KEPT = (
    "schema",
    "method",
    "config",
    "joints",
    "arm",
    "chain",
    "parameters",
    "extra",
    "covariance",
    "fit",
    "validation",
)


def export_json(source: Source, path: Path) -> list[str]:
    """Write `path`; return an empty list, since nothing is left out."""
    write_whole(path, strict_json.dumps(_kept(source), indent=2) + "\n")
    return []


def export_toml(source: Source, path: Path) -> list[str]:
    """Write `path`; return an empty list, since nothing is left out."""
    lines = ["# Base parameters of an identified arm [SI]; equations in docs/model.md. Read it with hil.load_model."]
    _write_table(lines, (), _kept(source))
    write_whole(path, "\n".join(lines) + "\n")
    return []


def _kept(source: Source) -> dict[str, Any]:
    result = source.result.to_json()
    return {key: result[key] for key in _KEPT if key in result}


def _write_table(lines: list[str], path: tuple[str, ...], table: dict[str, Any]) -> None:
    """Append a table's own values, then its subtables, then its arrays of tables."""
    tables = {key: value for key, value in table.items() if isinstance(value, dict)}
    arrays = {key: value for key, value in table.items() if _is_array_of_tables(value)}
    # TOML has no null: empty entries are left out.
    plain = [key for key in table if key not in tables and key not in arrays and table[key] is not None]
    lines += [f"{key} = {_value(table[key])}" for key in plain]
    for key, value in tables.items():
        lines += ["", f"[{'.'.join((*path, key))}]"]
        _write_table(lines, (*path, key), value)
    for key, rows in arrays.items():
        for row in rows:
            lines += ["", f"[[{'.'.join((*path, key))}]]"]
            _write_table(lines, (*path, key), row)


def _is_array_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(entry, dict) for entry in value)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)
