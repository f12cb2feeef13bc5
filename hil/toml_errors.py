"""Error messages for TOML files, and for the same tables written in Python: the key, the value, and what is allowed."""

import difflib
import re
from collections.abc import Sequence
from datetime import date, time
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from hil.unit_hints import allowed_by, in_other_units, unit_of

UNSAID = "~"
"""Prefix of names that pydantic adds to a location to identify an alternative; the file does not contain them."""

_EXPECTED = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "int_parsing": "must be a whole number",
    "float_parsing": "must be a number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "list_type": "must be a list [...]",
    "tuple_type": "must be a list [...]",
    "finite_number": "must be a finite number",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
}
_BOUNDS = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}


class _PlainErrors(type(BaseModel)):  # type: ignore[misc]  # pydantic's metaclass has no public name
    """Metaclass of tables created in Python: errors have the text of `describe` instead of pydantic's own.

    Tables read from a file are not created by a call, so their errors keep their location in the file.
    """

    def __call__(cls, *values: Any, **keys: Any) -> Any:
        if values:
            known = ", ".join(cls.model_fields)
            raise TypeError(f"{cls.__name__} takes keyword arguments: {known}; {_shown(values[0])} has no keyword.")
        try:
            return super().__call__(**keys)
        except ValidationError as error:
            raise ValueError(describe(error, cls.__name__, cls)) from None


if TYPE_CHECKING:
    _Table = BaseModel
else:

    class _Table(BaseModel, metaclass=_PlainErrors):
        """The base of `Described` at run time; it has a name because type checkers do not support an unnamed
        metaclass.
        """


class Described(_Table):
    """An immutable table of a TOML file. It can also be created in Python; errors are then plain ValueErrors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def describe(
    error: ValidationError, path: Path | str, root: type[BaseModel], table: str = "", joints: int | None = None
) -> str:
    """All errors of one file, one per line.

    table: location of the checked model in the file, "" for the whole file. joints: number of joints in the file, if it
    describes an arm.
    """
    details = _without_consequences(_joined_alternatives(error.errors(include_url=False)))
    faults = [_fault(detail, root, table) + _as_list(detail, joints) for detail in details]
    if len(faults) == 1:
        return f"{path}: {faults[0]}" + ("" if faults[0].endswith("?") else ".")
    lines = "".join(f"\n  {fault}" for fault in faults)
    return f"{path}: {len(faults)} errors:{lines}"


def _joined_alternatives(details: Sequence[Any]) -> list[Any]:
    """Merge the errors that pydantic reports for each alternative of a value that matches none of them."""
    joined: dict[tuple[Any, ...], Any] = {}
    for detail in details:
        if detail["type"] != "literal_error":
            joined[(*detail["loc"], len(joined))] = detail
            continue
        place = tuple(part for part in detail["loc"] if not str(part).startswith("literal["))
        if place in joined:
            expected = f"{joined[place]['ctx']['expected']}, {detail['ctx']['expected']}".replace(" or ", ", ")
            joined[place] = {**joined[place], "ctx": {"expected": expected}}
        else:
            joined[place] = {**detail, "loc": place}
    return list(joined.values())


def _without_consequences(details: Sequence[Any]) -> list[Any]:
    """Drop "too short" errors of lists that also have invalid entries."""
    places = [tuple(detail["loc"]) for detail in details]
    return [
        detail
        for detail, place in zip(details, places, strict=True)
        if detail["type"] != "too_short"
        or not any(len(each) > len(place) and each[: len(place)] == place for each in places)
    ]


def _fault(detail: Any, root: type[BaseModel], table: str) -> str:
    location = (table, *detail["loc"]) if table else detail["loc"]
    key, kind, context = _key(location), detail["type"], detail.get("ctx", {})
    if kind == "missing":
        return f"{key} is missing"
    if kind == "extra_forbidden":
        return f"{key} is not a known key; {_allowed_keys(detail['loc'], root)}"
    if kind == "value_error":
        # The message about a whole table already names its keys.
        about = key if isinstance(detail["input"], dict | BaseModel) else f"{key} = {_shown(detail['input'])}"
        said = str(context["error"])
        return said if not key or said.startswith(f"{key}.") else f"{about}: {said}"
    message = _exact_length(detail, root) or what_is_wrong(detail)
    return f"{key} = {_shown(detail['input'])}: {message}{_unit_hint(detail, root)}{_brackets_hint(key, detail)}"


def what_is_wrong(detail: Any) -> str:
    """State the requirement that a value violates, given one of pydantic's errors."""
    kind, value = detail["type"], detail["input"]
    if kind in _BOUNDS and str(value).lower() in ("nan", "inf", "-inf"):
        kind = "finite_number"
    return _EXPECTED.get(kind) or _constraint(kind, detail.get("ctx", {}), value) or str(detail["msg"])


def _exact_length(detail: Any, root: type[BaseModel]) -> str:
    """State the length that a list must have if it is too short or too long and only one length is allowed."""
    if detail["type"] not in {"too_short", "too_long"}:
        return ""
    field = _field_of(detail, root)
    lengths = {} if field is None else {type(each).__name__: each for each in field.metadata}
    if "MinLen" not in lengths or "MaxLen" not in lengths:
        return ""
    least, most = lengths["MinLen"].min_length, lengths["MaxLen"].max_length
    return f"must have exactly {least} entries" if least == most else ""


def _field_of(detail: Any, root: type[BaseModel]) -> Any:
    keys = [part for part in detail["loc"] if isinstance(part, str) and not part.startswith(UNSAID)]
    return fields_of(_table(detail["loc"], root)).get(keys[-1]) if keys else None


def _brackets_hint(key: str, detail: Any) -> str:
    if detail["type"] not in {"list_type", "tuple_type"} or not isinstance(detail["input"], dict):
        return ""
    return f". Write [[{key}]] with double brackets, once for each entry, instead of [{key}]"


def _as_list(detail: Any, joints: int | None) -> str:
    value = detail["input"]
    if joints is None or detail["type"] != "list_type" or isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    return f", with one entry for each joint: [{', '.join([str(value)] * joints)}]"


def _unit_hint(detail: Any, root: type[BaseModel]) -> str:
    """Name a unit in which an out-of-range number would make sense, and say what to write instead."""
    value = detail["input"]
    if detail["type"] not in _BOUNDS or isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    field = _field_of(detail, root)
    if field is None:
        return ""
    hint = in_other_units(value, unit_of(field.description), allowed_by(field))
    return f". {hint}" if hint else ""


def _constraint(kind: str, context: dict[str, Any], value: object) -> str | None:
    match kind:
        case "greater_than":
            return f"must be greater than {_bound(context['gt'])}"
        case "greater_than_equal":
            return f"must be at least {_bound(context['ge'])}"
        case "less_than":
            return f"must be less than {_bound(context['lt'])}"
        case "less_than_equal":
            return f"must be at most {_bound(context['le'])}"
        case "multiple_of":
            return f"must be a multiple of {context['multiple_of']}"
        case "enum":
            known = context["expected"].replace(" or ", ", ")
            near = _meant(value, known)
            return f"did you mean {near}?" if near else f"must be one of {known}"
        case "literal_error":
            if near := _meant(value, context["expected"]):
                return f"did you mean {near}?"
            return f"must be one of {context['expected']}{_in_thousands(context['expected'], value)}"
        case "string_too_short":
            return "must not be empty"
        case "string_too_long":
            return f"may have at most {context['max_length']} characters"
        case "too_short":
            return f"needs at least {context['min_length']} entries"
        case "too_long":
            return f"may have at most {context['max_length']} entries"
    return None


def _meant(value: object, expected: str) -> str:
    return meant_name(value, re.findall(r"'([^']*)'", expected)) if isinstance(value, str) else ""


def meant_name(given: str, names: Sequence[str]) -> str:
    """Return the name that was meant: one that differs only in case, spaces and dashes, or else the most similar one;
    "" if none is similar. Short names are never considered similar: grad is not rad.
    """
    plain = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in names}
    bare = re.sub(r"[^a-z0-9]", "", given.lower())
    long = [name for name in plain if len(name) > 4]
    # Two wrong characters can turn one servo's name into another's: XC430-W240 is not XM430-W210.
    cutoff = 0.85 if any(each.isdigit() for each in bare) else 0.75
    near = [bare] if bare in plain else difflib.get_close_matches(bare, long, n=1, cutoff=cutoff)
    return plain[near[0]] if near else ""


def _in_thousands(expected: str, value: object) -> str:
    """Name the allowed number that was probably meant if the value is in thousands or millions, such as a rate in
    Mbaud.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    for name, factor in (("thousands", 1e3), ("millions", 1e6)):
        meant = f"{value * factor:.0f}"
        if meant in expected.replace(",", "").split():
            return f". If it is in {name}, write {meant}"
    return ""


def _bound(value: float) -> str:
    """Write 12.566370614359172 as 12.57 and leave 100, 0.05 and whole numbers unchanged."""
    return f"{value:.4g}" if isinstance(value, float) and len(str(value)) > 9 else str(value)


def _key(location: Sequence[str | int]) -> str:
    """Format `("joints", 1, "id")` as `joints[2].id`: users count joints from one."""
    text = ""
    for part in location:
        if isinstance(part, str) and part.startswith(UNSAID):
            continue
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _shown(value: object) -> str:
    # Dates and times are the only values of a TOML file that repr writes as calls of Python classes.
    text = str(value) if isinstance(value, date | time) else repr(value)
    text = text.replace("True", "true").replace("False", "false")
    return text if len(text) <= 60 else text[:57] + "..."


def _allowed_keys(location: Sequence[str | int], root: type[BaseModel]) -> str:
    names = [name for name, field in fields_of(_table(location, root)).items() if not field.exclude]
    given = str(location[-1])
    same_letters = [name for name in names if sorted(name) == sorted(given)]
    close = same_letters or difflib.get_close_matches(given, names, n=1)
    return f"did you mean {close[0]}?" if close else f"allowed: {', '.join(names)}"


def fields_of(model: Any) -> dict[str, Any]:
    """The fields of a table, keyed as in the file."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _table(location: Sequence[str | int], root: type[BaseModel]) -> Any:
    """Return the pydantic model of the table that holds the last key of a location."""
    keys = [place for place, part in enumerate(location) if isinstance(part, str) and not part.startswith(UNSAID)]
    last = max(keys, default=0)
    model: Any = root
    free = False  # whether the next part is a key chosen by the user
    for part in location[:last]:
        if not isinstance(part, str) or part.startswith(UNSAID):
            continue
        if free:
            free = False
            continue
        fields = fields_of(model)
        if part not in fields:  # pydantic's name of an alternative
            continue
        free = get_origin(fields[part].annotation) is dict
        model = model_in(fields[part].annotation)
    return model


def model_in(annotation: Any) -> Any:
    """The pydantic model inside `list[Model]`, `tuple[Model, ...]` or `Model | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        found = model_in(argument)
        if found is not None:
            return found
    return None
