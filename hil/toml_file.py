"""The only module that reads TOML files, so that the same rules apply to configurations, fake arms and results.

Text is UTF-8, with or without the byte order mark that some Windows programs write.
"""

import codecs
import re
import tomllib
from pathlib import Path
from typing import Any

from hil.description.regular_file import not_a_file

MOST_BYTES = 4_000_000
"""Largest file that is read [bytes]: parsing a megabyte of numbers takes seconds."""


class TomlFileError(ValueError):
    """Raised if a file cannot be read or is not TOML. Its text is a complete message that names the file."""


def load_toml(path: Path) -> dict[str, Any]:
    """The values in a TOML file. Raises TomlFileError."""
    return parse_toml(read_toml_text(path), path)


def shortened(path: str) -> str:
    """Return a path, shortened to its beginning if it is too long for a message."""
    return path if len(path) <= 80 else f"{path[:80]}..."


def read_toml_text(path: Path) -> str:
    """The text of a file, without a byte order mark. Raises TomlFileError."""
    if said := not_a_file(path):
        raise TomlFileError(f"{path} cannot be read: {said}.")
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) <= MOST_BYTES:
            return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise TomlFileError(f"{path} cannot be read: it is {_encoding_of(path, error)}.") from error
    except OSError as error:
        raise TomlFileError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise TomlFileError(f"{str(path)!r} cannot be read: {error}.") from error
    raise TomlFileError(f"{path} cannot be read: it is larger than {MOST_BYTES / 1e6:.0f} MB.")


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """The values in `text`, the contents of `path`. Raises TomlFileError."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlFileError(_not_toml(path, error, text)) from error
    except RecursionError:
        raise TomlFileError(f"{path}: not valid TOML: a value has too many nested brackets.") from None
    except ValueError as error:  # Python's limit for integers
        found = re.search(r"\d[\d_]{4300,}", text)
        line = text.count("\n", 0, found.start()) + 1 if found else "?"
        raise TomlFileError(f"{path}: not valid TOML: a number has too many digits (at line {line}).") from error


def _encoding_of(path: Path, error: UnicodeDecodeError) -> str:
    """Describe the contents of a file that is not UTF-8 text, and say how to save it as UTF-8."""
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) and (b"=\0" in data or b"\0=" in data):
        return "UTF-16 text, as some Windows programs write it: save it as UTF-8"
    if b"\0" in data:
        return "not UTF-8 text but a binary file"
    number = error.object.count(b"\n", 0, error.start) + 1
    line = error.object.splitlines()[number - 1].decode("latin-1").strip()
    return f"not UTF-8 text, from line {number} on:\n  {line}\nSave it as UTF-8"


def _not_toml(path: Path, error: Exception, text: str) -> str:
    """The error message for text that the TOML parser rejects: the line, and the likely cause."""
    other = {".yaml": "YAML", ".yml": "YAML", ".json": "JSON", ".xml": "XML", ".urdf": "XML", ".csv": "CSV"}
    kind = other.get(path.suffix.lower())
    if kind is not None:
        return f"{path}: judging by its name, it is {kind}; hil's files are TOML. `hil init` writes one."
    lines = text.split("\n")
    place = re.search(r"at line (\d+)", str(error))
    number = int(place[1]) if place else len(lines)
    if again := _given_twice(str(error), text, number):
        return f"{path}: not valid TOML: {again}."
    if place is None or not 0 < number <= len(lines):
        return f"{path}: not valid TOML: {error}."
    line = lines[number - 1].strip()
    cause = next((said for pattern, said in _SYNTAX if re.search(pattern, _unquoted(line))), "")
    return f"{path}: not valid TOML: {error}:\n  {line}" + (f"\n{cause}" if cause else "")


def _given_twice(error: str, text: str, number: int) -> str:
    """Name the key or table that is repeated by the statement ending on line `number`; "" for other errors."""
    if not error.startswith(("Cannot overwrite", "Cannot declare")):
        return ""
    lines, begins = text.split("\n"), _beginnings(text)
    number = max((each for each in begins if each <= number), default=number)
    table = ""
    given: dict[tuple[str, str], int] = {}
    for count in begins:
        header, key = _HEADER.match(lines[count - 1]), _KEY.match(lines[count - 1])
        if header is None and key is None:
            continue
        what = key[1] if key else f"{header[1]}{header[2]}{header[3]}" if header else ""
        within = table if key else ""
        if count == number and header and (said := _other_brackets(header, lines, [*begins])):
            return said
        if count == number:
            return _repeated(what, within, number, given.get((within, what)))
        given[within, what] = count
        if header:
            table = what
        if header and header[1] == "[[":  # this table and its subtables are new
            given = {each: at for each, at in given.items() if not _is_within(each, header[2])}
            table = f"the {what} of line {count}"
    return ""


def _other_brackets(header: re.Match[str], lines: list[str], begins: list[int]) -> str:
    """Return a message if the table of this header is given both as [name] and as [[name]], otherwise ""."""
    at: dict[str, int] = {}
    for count in begins:
        other = _HEADER.match(lines[count - 1])
        if other and other[2] == header[2]:
            at.setdefault(other[1], count)
    if len(at) < 2:
        return ""
    name = header[2]
    return (
        f"line {at['[']} has [{name}] and line {at['[[']} has [[{name}]]. Write [[{name}]], with two brackets, "
        "wherever there may be several such tables"
    )


def _repeated(what: str, table: str, number: int, first: int | None) -> str:
    where = f" in {table}" if table else ""
    if first is None:
        return f"{what} on line {number} is already given{where}, in another form. Delete one of them"
    return f"{what} is given twice{where}, on lines {first} and {number}. Delete one of them"


def _is_within(given: tuple[str, str], name: str) -> bool:
    """Whether a (table, key) pair belongs to the table `name`; for a header, the pair's table is ""."""
    table, key = given
    return re.match(rf"(?:the )?\[\[?{re.escape(name)}[\].]", table or key) is not None


def _beginnings(text: str) -> list[int]:
    """Numbers, from 1, of the lines on which a statement begins. Lines within a multi-line value are left out."""
    found, line, depth = [1], 1, 0
    for token in _TOKEN.findall(text):
        line += token.count("\n")
        depth += (token in "[{") - (token in "]}")
        if token == "\n" and depth <= 0:
            found.append(line)
    return found


_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*|[\[\]{}\n]', re.DOTALL
)
"""Strings, comments, brackets and line endings."""

_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*(\]\]?)")
_KEY = re.compile(r"^\s*([\w.\"'-]+)\s*=")
_NUMBER = r"[-+]?\d[\d_.]*(?:[eE][-+]?\d+)?"
_SYNTAX = (
    (rf"{_NUMBER}\s*(?:°|º|deg)", "Angles are numbers in rad, without a degree sign or unit: 90 degrees is 1.5708."),
    (rf"=\s*{_NUMBER.replace('.', '', 1)},\d+\s*$", "The decimal separator is a point, not a comma: 4.0, not 4,0."),
    (r"[\[,]\s*[-+]?\d+,0\d", "The decimal separator is a point, not a comma: 1.06, not 1,06."),
    (r"[=\[,]\s*(?:True|False|TRUE|FALSE)\b", "Write true or false in lower case."),
    (r"[=\[,]\s*(?:yes|no|on|off|None|null|nil)\b", "Write true or false; leave out a key that has no value."),
    (rf"[=\[,]\s*{_NUMBER}\s*[%A-Za-zµμΩ]", "Write the number without its unit; each key has one fixed unit."),
    (r"=\s*[A-Za-z/]", "Text needs quotes."),
    (r"=\s*$", "The value is missing."),
    (r"^\w[\w.-]*\s*:", "Write = between key and value, not a colon."),
    (r"[“”‘’„]", "Use straight quotes."),
)
"""Patterns to match with a rejected line (without its comment and quoted strings), and the likely cause for each."""


def _unquoted(line: str) -> str:
    return re.sub(r"\"[^\"]*\"|'[^']*'", '""', line).partition("#")[0].strip()
