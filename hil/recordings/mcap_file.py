"""MCAP files and ROS 2 bags that contain them: decodes JSON and ROS 2 messages and merges topics into one table.

Every number in a message becomes a column: `/topic.field`, or `/topic.field[2]` for an entry of a list. If a message
has a list `name` in addition to lists of numbers, as sensor_msgs/JointState does, these names replace the indices:
`/joint_states.effort.elbow`.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import CsvError
from hil.recordings.table import Table, Values

TIME = "time"
LARGEST_LIST = 64  # a larger one is an image or a point cloud
_PLAIN = (bool, int, float)


@dataclass
class _Topic:
    """Messages of one topic: times [ns since 1970] and values by column name."""

    time: list[int] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)

    def add(self, time: int, numbers: Mapping[str, float]) -> None:
        for name in numbers:
            if name in self.values:
                continue
            self.values[name] = [np.nan] * len(self.time)
        self.time.append(time)
        for name, column in self.values.items():
            column.append(numbers.get(name, np.nan))


def is_bag(path: Path) -> bool:
    """Whether the folder `path` is a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def read_bag(folder: Path) -> list[Table]:
    """Read the table of a ROS 2 bag with MCAP storage. Raises CsvError."""
    files = sorted(folder.glob("*.mcap"))
    if not files:
        kept = ", ".join(sorted({path.suffix for path in folder.iterdir() if path.suffix != ".yaml"})) or "nothing"
        raise CsvError(
            f"{folder} is a ROS 2 bag without MCAP files (it holds {kept}). Convert it with `ros2 bag convert` and "
            "storage_id: mcap."
        )
    return [_table(str(folder), files)]


def read_mcap(path: Path) -> list[Table]:
    """Read the table in one MCAP file. Raises CsvError."""
    return [_table(str(path), [path])]


def _table(source: str, files: list[Path]) -> Table:
    topics: dict[str, _Topic] = {}
    for path in files:
        for topic, time, message in _messages(path):
            topics.setdefault(topic, _Topic()).add(time, dict(_numbers(topic, message)))
    topics = {name: each for name, each in topics.items() if each.values}
    if not topics:
        raise CsvError(f"{source} holds no messages with numbers.")
    # The topic with the most samples defines the rows; values of other topics are held until their next message.
    first = max(topics, key=lambda name: len(topics[name].time))
    order = np.argsort(topics[first].time, kind="stable")
    at = np.array(topics[first].time)[order]
    # Relative to the first: nanoseconds since 1970 have too many digits for a float.
    columns: dict[str, Values] = {TIME: (at - at[0]) * 1e-9}
    for each in topics.values():
        places = np.argsort(each.time, kind="stable")
        when = np.array(each.time)[places]
        same = when.shape == at.shape and np.array_equal(when, at)
        row = np.arange(at.size) if same else np.searchsorted(when, at, side="right") - 1
        for column, values in each.values.items():
            held = np.array(values)[places][np.maximum(row, 0)]
            columns[column] = np.where(row < 0, np.nan, held)
    return Table(source, columns)


def _messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, time [ns since 1970], message) for each decodable message. Raises CsvError if there is none."""
    try:
        from mcap.exceptions import UnsupportedCompressionError
        from mcap.reader import make_reader
    except ImportError as error:
        raise CsvError("MCAP needs the package mcap: pip install 'hil[recordings]'.") from error
    found = False
    refused: set[str] = set()
    try:
        with path.open("rb") as file:
            decoders: dict[int, Callable[[bytes], Any] | None] = {}
            for schema, channel, message in make_reader(file).iter_messages():
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(schema, channel)
                decode = decoders[channel.id]
                if decode is None:
                    refused.add(f"{channel.topic} ({channel.message_encoding})")
                    continue
                found = True
                decoded = decode(message.data)
                yield channel.topic, _stamp(decoded, message.log_time), decoded
    except Exception as error:  # of mcap, its decompressors and decoders
        is_plain = isinstance(error, UnsupportedCompressionError) or getattr(error, "filename", None)
        why = error if is_plain else "it is not an MCAP file, or it is incomplete or damaged"
        raise CsvError(f"{path} cannot be read: {why}.") from error
    if not found:
        what = ", ".join(sorted(refused)) or "no messages"
        raise CsvError(
            f"{path} holds nothing that can be decoded here: {what}. hil reads JSON and, after "
            "pip install 'hil[recordings]', ROS 2 (cdr)."
        )


def _decoder(schema: Any, channel: Any) -> Callable[[bytes], Any] | None:
    if channel.message_encoding == "json":
        return json.loads
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        return None
    decoder: Callable[[bytes], Any] | None = DecoderFactory().decoder_for(channel.message_encoding, schema)
    return decoder


def _stamp(message: Any, log_time: int) -> int:
    """Time stamp in a message's header or, if there is none, the message's log time [ns since 1970]."""
    stamp = _get(_get(message, "header"), "stamp")
    seconds, nanoseconds = _get(stamp, "sec"), _get(stamp, "nanosec")
    if isinstance(seconds, int) and isinstance(nanoseconds, int) and (seconds or nanoseconds):
        return seconds * 10**9 + nanoseconds
    return log_time


def _get(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, Mapping) else getattr(message, name, None)


def _fields(message: Any) -> list[tuple[str, Any]]:
    if isinstance(message, Mapping):
        return list(message.items())
    return [(name, getattr(message, name)) for name in getattr(message, "__slots__", ()) if not name.startswith("_")]


def _numbers(prefix: str, message: Any) -> Iterator[tuple[str, float]]:
    fields = _fields(message)
    labels = next((value for name, value in fields if name == "name" and isinstance(value, list)), None)
    for name, value in fields:
        full = f"{prefix}.{name}"
        if isinstance(value, _PLAIN):
            yield full, float(value)
        elif value is None:
            yield full, np.nan
        elif hasattr(value, "__len__") and not isinstance(value, str | bytes | Mapping):
            if len(value) > LARGEST_LIST:
                continue
            for k, entry in enumerate(value):
                if isinstance(entry, _PLAIN):
                    labelled = labels is not None and len(labels) == len(value)
                    yield f"{full}.{labels[k]}" if labels and labelled else f"{full}[{k}]", float(entry)
        elif not isinstance(value, str | bytes) and name != "header":
            yield from _numbers(full, value)
