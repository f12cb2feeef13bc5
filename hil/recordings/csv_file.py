"""CSV files as written by other programs: any delimiter, decimal commas, byte order mark, comments, a line of units."""

import csv
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import numpy as np

from hil.errors import CsvError
from hil.recordings.table import Table, Values
from hil.recordings.units import unit_of
from hil.runs.file_size import MOST_CSV_BYTES

_REMARKS = ("#", "%", "//")

_LARGEST = 1e30
"""Largest absolute value that is read as a number; the largest in practice are time stamps in nanoseconds (about 1e18).
"""


def read_csv_table(path: Path) -> Table:
    """Read the table in `path`. Raises CsvError. An empty field or `nan` is a missing value."""
    text = _text(path)
    if text.lstrip().startswith(("<!", "<?", "<html", "{", "[{")):
        raise CsvError(f"{path} cannot be read: it is HTML, XML or JSON. Export the data as CSV.")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    if long := [number for number, line in lines if len(line) > csv.field_size_limit()]:
        raise CsvError(f"{path}, line {long[0]} is too long: at most {csv.field_size_limit()} characters can be read.")
    remarks = [line for _, line in lines if line.lstrip().startswith(_REMARKS)]
    rows = [(number, line) for number, line in lines if not line.lstrip().startswith(_REMARKS)]
    announced = rows[0][1][4:5] if rows and rows[0][1].lower().startswith("sep=") else ""  # as Excel writes it
    rows = rows[1:] if announced else rows
    if not rows:
        raise CsvError(f"{path} is empty; it needs a header line and at least one line of numbers.")
    delimiter = announced or _delimiter([line for _, line in rows])
    header, rows = _header(path, rows, remarks, delimiter)
    double = {name for name in header if header.count(name) > 1}
    if double:
        raise CsvError(f"{path}: two columns are named {sorted(double)[0]!r}; rename one of them.")
    fields = [(number, _split(line, delimiter)) for number, line in rows]
    units: dict[str, str] = {}
    if fields and _are_units(fields[0][1]):
        named = zip(header, fields[0][1], strict=False)
        units = {name: field.strip(" []()") for name, field in named if field.strip(" []()")}
        fields = fields[1:]
    if not fields:
        raise CsvError(f"{path} has no line of numbers, only a header.")
    wide = len(header)
    if all(len(row) == wide + 1 and not row[-1].strip() for _, row in fields):  # each line ends in a delimiter
        fields = [(number, row[:-1]) for number, row in fields]
    for number, row in fields:
        if len(row) != wide:
            raise CsvError(f"{path}, line {number}: {len(row)} fields for {wide} columns.")
    comma = delimiter != ","
    columns = {name: _numbers([row[k] for _, row in fields], comma) for k, name in enumerate(header)}
    odd = {name: np.isinf(values) for name, values in columns.items()}
    texts = {name: fields[int(where.argmax())][1][header.index(name)] for name, where in odd.items() if where.any()}
    return Table(str(path), columns, units, fields[0][0], "line", texts)


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > MOST_CSV_BYTES:
            raise CsvError(f"{path} is larger than {MOST_CSV_BYTES // 2**20} MB, the most that can be read. Split it.")
        data = path.read_bytes()
    except OSError as error:
        raise CsvError(f"{path} cannot be read: {error.strerror}.") from error
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        raise CsvError(f"{path} cannot be read: it is not a text file but a binary one. Export it as CSV.")
    return text


def _delimiter(lines: list[str]) -> str | None:
    """Find the delimiter that splits the first lines into the most fields.

    Returns None for white space.
    """
    some = lines[: min(len(lines), 20)]
    best: tuple[int, str | None] = (0, None)
    for each in (";", "\t", ",", "|"):
        counts = {line.count(each) for line in some[1:]} or {some[0].count(each)}
        least = min(counts)
        # Decimal commas may appear in every field, so a semicolon is preferred if it occurs as often as another.
        if least > 0 and some[0].count(each) > 0 and least > best[0] and not (each == "," and best[1] is not None):
            best = (least, each)
    if best[1] is None and any("," in line for line in some):
        return ","
    if best[1] is None and all(len(line.split()) > 1 for line in some):
        return None
    return best[1] or ","


def _header(
    path: Path, rows: list[tuple[int, str]], remarks: list[str], delimiter: str | None
) -> tuple[list[str], list[tuple[int, str]]]:
    first = [field.strip() for field in _split(rows[0][1], delimiter)]
    if not all(_is_number(field) for field in first):
        return first, rows[1:]
    for remark in reversed(remarks):
        names = [name.strip() for name in _split(remark.lstrip().lstrip("#%/").strip(), delimiter)]
        if len(names) == len(first):
            return names, rows
    raise CsvError(
        f"{path} has no header line, only numbers. Put the names of the {len(first)} columns into its first line."
    )


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return not field
    return "_" not in field


def _are_units(fields: list[str]) -> bool:
    """Whether a line states units: at least one of its fields is a known unit, and none is a number."""
    texts = [field.strip(" []()") for field in fields]
    known = any(unit_of(text) is not None and not text.isdigit() for text in texts)
    return known and not any(text and np.isfinite(_number(text, decimal_comma=True)) for text in texts)


def _numbers(fields: list[str], decimal_comma: bool) -> Values:
    # Python reads 1_000 as a number, but its author may have meant something else. No measured value exceeds _LARGEST.
    with suppress(ValueError):
        if "_" not in "".join(fields):
            values = np.array(fields, dtype=np.float64)
            return np.where(np.abs(values) > _LARGEST, np.inf, values)
    # Only columns that are used must be numeric: text, such as a comment, is not an error and is stored as infinity.
    return np.array([_number(field, decimal_comma) for field in fields])


def _number(field: str, decimal_comma: bool) -> float:
    text = field.strip()
    if text.lower() in {"", "nan", "null", "none", "na", "n/a", "-"}:
        return np.nan
    if decimal_comma and text.count(",") == 1:
        text = text.replace(".", "").replace(",", ".") if text.count(".") == 1 else text.replace(",", ".")
    with suppress(ValueError):
        if "_" not in text:
            return float(text) if abs(float(text)) <= _LARGEST else np.inf
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return np.inf
