"""Guess the meaning of columns from their names, if [columns] does not specify it."""

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from hil.config.csv_columns import PLANAR, TORQUE_UNITS, Columns
from hil.errors import CsvError
from hil.recordings.table import Table
from hil.recordings.units import UNITS, split_head, unit_of

_TIME = re.compile(
    r"(time|t|date_?time|timestamp|stamp|time_?stamp|seconds|secs|elapsed|clock)(_?s|_?sec|_?ms|_?us|_?ns)?", re.I
)
_KINDS = {
    "position": re.compile(r"(?<![a-z])(q|qpos|pos|position|angle|theta|phi|state)(?![a-z])", re.I),
    "torque": re.compile(r"(?<![a-z])(tau|torque|effort|trq)(?![a-z])", re.I),
    "current": re.compile(r"(?<![a-z])(i|cur|curr|current|amp|amps)(?![a-z])", re.I),
    "voltage": re.compile(r"(?<![a-z])(u|volt|volts|voltage)(?![a-z])", re.I),
    "pwm": re.compile(r"(?<![a-z])(pwm|duty)(?![a-z])", re.I),
}
_OF_UNIT = {
    "position": {"rad", "mrad", "deg", "turns", "ticks"},
    "torque": set(TORQUE_UNITS),
    "current": {"A", "mA"},
    "voltage": {"V", "mV"},
    "pwm": {"%"},
}
# Names of columns that do not hold measurements of a joint, or not of its angle.
_NOT_MEASURED = re.compile(
    r"(?<![a-z])(des|desired|ref|reference|goal|target|sp|setpoint|cmd|commanded|sim|est)(?![a-z])", re.I
)
_NOT_POSITION = re.compile(
    r"(?<![a-z])(vel|qvel|velocity|speed|acc|qacc|accel|dq|qd|qdd|ddq|temp|temperature|err|error)(?![a-z])", re.I
)
_LENGTHS = ("mm", "cm", "m", "in", "inch")
_EXAMPLE = 5  # number of columns in a recording of two joints
_SUPPLY = re.compile(r"(?<![a-z])(supply|battery|bus|input)(?![a-z])", re.I)


def guessed(table: Table, columns: Columns) -> Columns:
    """Complete `columns` from the table's column names. Raises CsvError if the names are ambiguous."""
    found: dict[str, object] = {}
    if columns.time is None and columns.rate is None:
        found["time"] = _time(table)
    if columns.position is None:
        found["position"] = _group(table, "position", columns)
    if columns.drive is None:
        for kind in ("torque", "current", "voltage", "pwm"):
            names = _group(table, kind, columns, needed=False)
            if names:
                found[kind] = names
                break
        else:
            raise _unclear(table, "torque, current, voltage or PWM", [])
    try:
        return Columns.model_validate(columns.model_dump(exclude_none=True) | found)
    except ValueError as error:
        said = str(error).split("Value error, ")[-1].split(" [type=")[0]
        raise CsvError(f"{table.source}: {said}. Set [columns] in --config ARM.toml (in Python: config=).") from error


def said(columns: Columns, table: Table) -> str:
    """Say how the columns were interpreted and which were not used."""
    drive = columns.drive or "torque"
    time = _described("time", [columns.time], columns, table) if columns.time else f"{columns.rate:g} samples a second"
    position = _described("position", columns.position or [], columns, table)
    driven = _described(drive, getattr(columns, drive), columns, table)
    used = {table.find(name)[0] for name in (columns.time, *(columns.position or []), *getattr(columns, drive)) if name}
    unused = [name for name in table.columns if name not in used]
    left_out = f" Not used: {', '.join(name or 'a column without a name' for name in unused)}." if unused else ""
    return f"{table.source}: columns read: time = {time}; position = {position}; {drive} = {driven}.{left_out}"


def _described(kind: str, names: Sequence[str], columns: Columns, table: Table) -> str:
    """The columns' names for a message, with the configured unit or, if the header states none, the assumed unit."""
    given = getattr(columns, f"{kind}_unit", None)
    if given is not None:
        return f"{', '.join(names)} [{given}]"
    if any(unit_of(table.find(name)[2] or "") in UNITS[kind] for name in names):
        return ", ".join(names)
    return f"{', '.join(names)} [no unit stated: {next(iter(UNITS[kind]))} assumed]"


def _time(table: Table) -> str:
    found = [name for name in table.columns if _TIME.fullmatch(_last(split_head(name)[0]))]
    exact = [name for name in found if name == "time"]
    if len(found) == 1 or exact:
        return (exact or found)[0]
    raise _unclear(table, "time", found)


def _group(table: Table, kind: str, columns: Columns, needed: bool = True) -> list[str] | None:
    """Find the columns of one kind, one per joint; None if there are none. Raises CsvError if several sets of columns
    are possible, or if the columns are needed but missing.
    """
    named: dict[str, list[str]] = defaultdict(list)
    for name in table.columns:
        bare, unit = split_head(name)
        stated = unit_of(table.units.get(name) or unit or "") or ""
        words = _spaced(bare)
        by_unit = stated in _OF_UNIT[kind]
        if not (_KINDS[kind].search(words) or (by_unit and kind == "position")) or (stated and not by_unit):
            continue
        wrong = kind == "position" and (_NOT_POSITION.search(words) or _NOT_MEASURED.search(words))
        if wrong or (kind == "voltage" and _SUPPLY.search(words)):
            continue
        named[_stem(bare)].append(name)
    groups = [names for names in named.values() if len(names) <= PLANAR]
    if needed and not groups and named:
        many = max(named.values(), key=len)
        raise CsvError(
            f"{table.source}: {', '.join(many)} seem to be the positions of {len(many)} joints; three or more joints "
            "need arm.urdf, columns.position and [[joints]] with names in --config ARM.toml (in Python: config=)."
        )
    if kind != "position" and columns.position is not None:
        groups = [names for names in groups if len(names) == len(columns.position)]
    if len(groups) == 1:
        return groups[0]
    if kind != "position" and len(groups) > 1:
        commanded = [each for each in groups if _NOT_MEASURED.search(_spaced(each[0]))]
        if len(commanded) == 1:  # a commanded value is an input; a measured one depends on the motion
            return commanded[0]
    if needed or len(groups) > 1 or (named and not groups):
        raise _unclear(table, kind, [name for names in named.values() for name in names])
    return None


def _last(name: str) -> str:
    return re.split(r"[./]", name)[-1]


def _spaced(name: str) -> str:
    """Split names such as `pos_meas1` and `observation.state.0` into words that can be searched for."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])|[_./\[\]\-]+", " ", name)


def _stem(name: str) -> str:
    """The part of a name that is common to the columns of one kind: the name without its number or, if it has none,
    without its last dotted part or the name of a joint.
    """
    numbered = re.sub(r"\d+", "#", name)
    if numbered != name:
        return numbered
    if "." in name:
        return name.rsplit(".", 1)[0]
    return re.sub(r"(^|_)(shoulder|elbow|hip|knee|base|upper|lower)(_|$)", "_", name, flags=re.IGNORECASE)


def _unclear(table: Table, what: str, found: Iterable[str]) -> CsvError:
    some = list(found)
    lengths = [name for name in table.columns if (table.units.get(name) or split_head(name)[1] or "") in _LENGTHS]
    if what == "position" and not some and lengths:
        return CsvError(
            f"{table.source}: {' and '.join(lengths)} {'is a length' if len(lengths) == 1 else 'are lengths'}, but the "
            "angle of each joint is needed (rad, deg, turns or ticks), from the base outwards. The position of the "
            "tip does not determine the joint angles; record the encoders, or compute the angles first."
        )
    seen = f"several are candidates ({', '.join(some[:12])})" if some else "none has a recognisable name"
    return CsvError(
        f"{table.source}: which columns hold {what}? Of {table.listed()}, {seen}. Specify them in --config ARM.toml "
        f'(in Python: config="ARM.toml"). For example, if these are the right ones:\n{_example(table)}'
    )


def _example(table: Table) -> str:
    """A `[columns]` table with this file's own column names. Names that are not recognised are assumed to be in the
    usual order.
    """
    words = {split_head(name)[0]: _spaced(split_head(name)[0]) for name in table.columns}
    kinds = {name: _kind(name, spaced) for name, spaced in words.items()}
    time = next((name for name, kind in kinds.items() if kind == "time"), None)
    position = _first_group(kinds, "position")
    drive = next((kind for kind in ("torque", "current", "voltage", "pwm") if kind in kinds.values()), "torque")
    driven = _first_group(kinds, drive)
    joints = len(position or driven) or (1 if len(words) < _EXAMPLE else PLANAR)
    rest = [name for name, kind in kinds.items() if kind == "unknown"]
    if time is None and len(rest) > joints * ((not position) + (not driven)):
        time = rest.pop(0)
    position = position or [rest.pop(0) for _ in range(min(joints, len(rest)))]
    driven = driven or rest[:joints]
    if len(position) != len(driven) or not position:
        time, position, drive, driven = "time", ["q1", "q2"], "torque", ["tau1", "tau2"]
    when = f"time = {quoted(time)}" if time is not None else "rate = 200.0  # samples per second"
    return "\n".join(("[columns]", when, listed("position", position), listed(drive, driven)))


def listed(key: str, names: Iterable[str]) -> str:
    """The line of a TOML file that gives the names of columns."""
    return f"{key} = [{', '.join(map(quoted, names))}]"


def quoted(name: str) -> str:
    """The name of a column, as in a TOML file."""
    return json.dumps(name, ensure_ascii=False)


def _kind(name: str, words: str) -> str:
    """The kind of column that a name suggests: "other" for one that is certainly not needed, "unknown" if unclear."""
    if _TIME.fullmatch(_last(name)):
        return "time"
    found = next((kind for kind, pattern in _KINDS.items() if pattern.search(words)), "unknown")
    if _NOT_POSITION.search(words) or (found == "position" and _NOT_MEASURED.search(words)):
        return "other"
    return found


def _first_group(kinds: Mapping[str, str], wanted: str) -> list[str]:
    """The first set of columns of a kind whose names differ only in the joint's number; sets that are too large are
    skipped.
    """
    groups: dict[str, list[str]] = defaultdict(list)
    for name, kind in kinds.items():
        if kind == wanted:
            groups[_stem(name)].append(name)
    return next((names for names in groups.values() if len(names) <= PLANAR), [])
