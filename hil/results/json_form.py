"""Lossless conversion of frozen dataclasses to JSON values and back. Standard library only, so that models load fast.

A field is stored under its own name, or under the name in its metadata entry "key". A field with False in its metadata
entry "json" is not stored. An optional field whose default is None is omitted if it is None. Unknown keys are
ignored when reading.

JSON has no infinity and no NaN: they are written as null, which is read as NaN, or as infinity in a `Spread`.
"""

import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

_NULL_IS_INFINITE = "null is infinite"

Spread = Annotated[float, _NULL_IS_INFINITE]
"""A standard error or variance; infinite if the recording contains no information about the parameter."""

_NOT_NEGATIVE = "not negative"

StandardError = Annotated[float, _NULL_IS_INFINITE, _NOT_NEGATIVE]
"""Like `Spread`, but never negative."""

T = TypeVar("T")


class FormError(ValueError):
    """A JSON value does not match the dataclass. The message, such as "has no 'arm'", continues a sentence that
    starts with "it".
    """


def to_json(value: Any) -> Any:
    """Convert a dataclass to dictionaries, lists, numbers and strings."""
    if is_dataclass(value):
        return {
            _key(field): to_json(entry)
            for field in fields(value)
            if ((entry := getattr(value, field.name)) is not None or field.default is not None) and not _is_aside(field)
        }
    if isinstance(value, Mapping):
        return {name: to_json(entry) for name, entry in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(entry) for entry in value]
    return value


def from_json(kind: type[T], value: Any) -> T:
    """Convert the output of `to_json` back to a `kind`. Raises FormError."""
    read: T = _read(kind, value, "")
    return read


def _read(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        if value is None and _NULL_IS_INFINITE in arguments:
            return math.inf
        found = _read(arguments[0], value, where)
        if _NOT_NEGATIVE in arguments and found < 0.0:
            raise FormError(f"has {_shown(value)} as {where!r}, which cannot be negative")
        return found
    if origin in (Union, types.UnionType):
        (wanted,) = (each for each in arguments if each is not type(None))
        return None if value is None else _read(wanted, value, where)
    if is_dataclass(kind):
        return _read_dataclass(kind, value, where)
    if origin in (tuple, Sequence):
        entries = _checked(value, list, where)
        if len(arguments) > 1 and arguments[-1] is not ... and len(entries) != len(arguments):
            raise FormError(f"has {len(entries)} entries instead of {len(arguments)} in {where!r}")
        return tuple(_read(arguments[0], entry, f"{where}[{index}]") for index, entry in enumerate(entries))
    if origin is not None and issubclass(origin, Mapping):
        table = _checked(value, dict, where)
        return {name: _read(arguments[1], entry, _below(where, name)) for name, entry in table.items()}
    if kind is float:
        return math.nan if value is None else float(_checked(value, (int, float), where))
    return _checked(value, kind, where)


def _read_dataclass(kind: Any, value: Any, where: str) -> Any:
    table = _checked(value, dict, where)
    hints = _hints(kind)
    given = {}
    for field in fields(kind):
        key = _key(field)
        if key in table:
            given[field.name] = _read(hints[field.name], table[key], _below(where, key))
        elif field.default is MISSING and field.default_factory is MISSING:
            raise FormError(f"has no {_below(where, key)!r}")
    return kind(**given)


def _checked(value: Any, kind: Any, where: str) -> Any:
    # In Python, a bool is an int.
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise FormError(f"has {_shown(value)} as {where!r}" if where else f"is {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _key(field: Field[Any]) -> str:
    return str(field.metadata.get("key", field.name))


def _is_aside(field: Field[Any]) -> bool:
    return field.metadata.get("json") is False


def _below(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key
