"""MCAP export for Foxglove and PlotJuggler: one topic per joint with JSON messages and their schema; result.json is
attached.

The topics `/transforms` and `/arm` hold the moving arm's frames and shapes, for a 3D panel.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hil import __version__
from hil.errors import not_written
from hil.estimator.arrays import Array
from hil.export.columns import COLUMN_UNITS
from hil.export.foxglove import (
    SCENE,
    TRANSFORMS,
    scene_message,
    scene_schema,
    transform_messages,
    transforms_schema,
)
from hil.export.moving_scene import moving_scene
from hil.export.source import MissingPackages, Recorded

__all__ = ["export_mcap"]

_SHOWN_HZ = 50.0
"""Rate at which frames are written [Hz], high enough for smooth motion on a screen."""
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
        raise MissingPackages("MCAP needs the package mcap") from error
    try:
        with path.open("wb") as file:
            writer: Any = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="", library=f"hil {__version__}")
            _write(writer, source)
            writer.finish()
    except OSError as error:
        raise not_written(path, error) from error
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
    _write_scene(writer, source, start)
    if source.result is not None:
        result = source.result_json.encode()
        writer.add_attachment(
            create_time=start, log_time=start, name="result.json", media_type="application/json", data=result
        )


def _write_scene(writer: Any, source: Recorded, start: int) -> None:
    """Write the arm's shapes once, and its frames for every sample in which all joints were read."""
    scene = moving_scene(source.config)
    samples = source.samples
    deadline: Array = samples["deadline"]
    position: Array = samples["position"]
    time = deadline - deadline[0]
    due = np.unique(np.searchsorted(time, np.arange(0.0, float(time[-1]) + 1.0 / _SHOWN_HZ, 1.0 / _SHOWN_HZ)))
    due = due[due < len(samples)]
    seen = due[np.isfinite(position[due]).all(axis=1)]
    stamps = [start + round(float(time[row]) * 1e9) for row in seen]
    moving = transform_messages(scene, position[seen].T.astype(np.float64), stamps)
    for topic, name, schema, messages in (
        ("/arm", SCENE, scene_schema(), [(start, scene_message(scene, start))]),
        ("/transforms", TRANSFORMS, transforms_schema(), list(zip(stamps, moving, strict=True))),
    ):
        known = writer.register_schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
        channel = writer.register_channel(topic=topic, message_encoding="json", schema_id=known)
        for stamp, message in messages:
            data = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channel_id=channel, log_time=stamp, publish_time=stamp, data=data)


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
