"""MCAP export, for Foxglove and PlotJuggler: one topic per joint, JSON messages with a schema, result.json attached."""

import json
import math
from pathlib import Path
from typing import Any

from hil import __version__
from hil.errors import ExportError, RunFolderError
from hil.export.columns import COLUMN_UNITS
from hil.export.source import Recorded

_WHOLE = ("phase", "segment", "period", "error", "missing")
_TIMES = ("deadline", "time_before_write", "time_after_read")
_SHARED = (*_TIMES, "phase", "segment", "period")
_PER_JOINT = (
    *("goal_current", "current", "velocity", "position", "error", "missing"),
    *("servo_clock", "supply_voltage", "temperature"),
)


def export_mcap(source: Recorded, path: Path) -> list[str]:
    """Write `path`. Each message is stamped with its sample's deadline relative to the start of the run. Needs mcap."""
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError as error:
        raise ExportError("MCAP needs the package mcap: pip install 'hil[export]'.") from error
    try:
        with path.open("wb") as file:
            writer: Any = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="", library=f"hil {__version__}")
            _write(writer, source)
            writer.finish()
    except OSError as error:
        raise RunFolderError(f"{path} cannot be written: {error.strerror}.") from error
    return []


def _write(writer: Any, source: Recorded) -> None:
    schema = writer.register_schema(name="hil.Sample", encoding="jsonschema", data=json.dumps(_schema()).encode())
    topics = [f"/{name}" for name in source.joints]
    channels = [writer.register_channel(topic=topic, message_encoding="json", schema_id=schema) for topic in topics]
    samples = source.samples
    start = int(source.started * 1e9)
    first = float(samples["deadline"][0])
    columns = {name: samples[name].tolist() for name in (*_SHARED, *_PER_JOINT)}
    for row, deadline in enumerate(columns["deadline"]):
        stamp = start + round((deadline - first) * 1e9)
        shared = {name: columns[name][row] for name in _SHARED}
        for joint, channel in enumerate(channels):
            message = shared | {name: _number(columns[name][row][joint]) for name in _PER_JOINT}
            data = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channel_id=channel, log_time=stamp, publish_time=stamp, data=data, sequence=row)
    if source.result is not None:
        result = source.result_json.encode()
        writer.add_attachment(
            create_time=start, log_time=start, name="result.json", media_type="application/json", data=result
        )


def _number(value: float) -> float | None:
    """Replace NaN by None: JSON has no NaN, so a missing measurement is null."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _schema() -> dict[str, Any]:
    properties: dict[str, Any] = {}
    for name in (*_SHARED, *_PER_JOINT):
        properties[name] = {"type": "integer"} if name in _WHOLE else {"type": ["number", "null"]}
        if name in COLUMN_UNITS:
            properties[name]["description"] = COLUMN_UNITS[name]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "type": "object", "properties": properties}
