"""Recognition of numbers given in the wrong unit: 10000 where seconds are expected may be 10 s in milliseconds.

A key's unit is taken from its description: its first words ("N m/A at the output shaft"), the text
in brackets ("viscous friction [N m s/rad]"), or the text after a comma ("roll, pitch and yaw, rad").
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_args

from pydantic.fields import FieldInfo

_DEGREE = math.pi / 180
_KGF_CM = 0.0980665
_Unit = tuple[str, float]

FRACTION = "1"
OTHER_UNITS: dict[str, tuple[tuple[_Unit, ...], ...]] = {
    "s": ((("ms", 1e-3), ("us", 1e-6)),),
    "us": ((("s", 1e6), ("ms", 1e3)),),
    "rad": ((("degrees", _DEGREE), ("mrad", 1e-3)),),
    "rad/s": ((("degrees/s", _DEGREE), ("mrad/s", 1e-3)), (("rpm", math.pi / 30),)),
    "m": ((("mm", 1e-3),), (("cm", 1e-2),)),
    "m/s^2": ((("mm/s^2", 1e-3), ("cm/s^2", 1e-2)),),
    "kg": ((("g", 1e-3),),),
    "kg m^2": ((("g m^2", 1e-3), ("kg mm^2", 1e-6), ("g cm^2", 1e-7), ("g mm^2", 1e-9)),),
    "A": ((("mA", 1e-3),),),
    "A/s": ((("mA/s", 1e-3),),),
    "V": ((("mV", 1e-3),),),
    "ohm": ((("mOhm", 1e-3),),),
    "Hz": ((("kHz", 1e3), ("mHz", 1e-3)), (("rad/s", 1 / math.tau),)),
    "samples per second": ((("kHz", 1e3),),),
    "N m": ((("mN m", 1e-3),), (("N cm", 1e-2),), (("kgf cm", _KGF_CM),)),
    "N m/A": ((("mN m/A", 1e-3),), (("N cm/A", 1e-2),), (("kgf cm/A", _KGF_CM),)),
    "N m/V": ((("mN m/V", 1e-3),), (("N cm/V", 1e-2),), (("kgf cm/V", _KGF_CM),)),
    "N m/rad": ((("mN m/rad", 1e-3), ("N mm/rad", 1e-3), ("N m/degree", 1 / _DEGREE)),),
    "N m s/rad": ((("mN m s/rad", 1e-3), ("N m s/degree", 1 / _DEGREE)),),
    "K/W": ((("mK/W", 1e-3),),),
    "degrees C": ((("millidegrees", 1e-3),),),
    "ppm": ((("a fraction", 1e6), ("ppb", 1e-3)),),
    "ticks": ((("thousandths", 1e-3),),),
    FRACTION: ((("percent", 1e-2), ("per mille", 1e-3)),),
}
"""Units that people use for a quantity, as multiples of its unit. In each group, only the first unit that makes sense
is proposed.
"""

_LEAST = {"m/s^2": 1.5, "m": 1e-2, "samples per second": 1.0}
"""Smallest plausible magnitude in each unit, apart from 0: smaller proposals would be misleading."""

_BY_LENGTH = sorted((re.escape(unit) for unit in OTHER_UNITS if unit != FRACTION), key=len, reverse=True)
_IN_DESCRIPTION = re.compile(rf"(?:^|\[|, )(?:C\b|({'|'.join(_BY_LENGTH)}))(?! per N m)(?=$|[\],;: ])")
_FRACTION = re.compile(r"\b(?:relative|fraction|probability|share|N m per N m)\b")


def unit_of(description: str | None) -> str | None:
    """Return the unit named by a key's description; FRACTION for a ratio; None if it names no unit."""
    text = description or ""
    if found := _IN_DESCRIPTION.search(text):
        return found[1] or "degrees C"
    return FRACTION if _FRACTION.search(text) else None


def in_other_units(values: float | Sequence[float], unit: str | None, makes_sense: Callable[[float], bool]) -> str:
    """Return a hint such as "If it is in ms, write 10" with up to three units in which every value makes sense; "" if
    there are none.

    Args:
        values: the given number or list; for a list, the proposal is a list too.
        unit: the expected unit.
        makes_sense: whether a value in that unit is allowed and plausible.
    """
    given = [values] if isinstance(values, int | float) else list(values)
    least = _LEAST.get(unit or "", 0.0)

    def is_meant(value: float) -> bool:
        return makes_sense(value) and (value == 0 or abs(value) >= least)

    proposals = []
    for name, factor in _fitting(given, OTHER_UNITS.get(unit or "", ()), is_meant):
        converted = ", ".join(f"{value * factor:.4g}" for value in given)
        proposals.append(f"in {name}, write {converted if isinstance(values, int | float) else f'[{converted}]'}")
    return f"If it is {'; if '.join(proposals[:3])}" if proposals else ""


def _fitting(
    given: Sequence[float], groups: Sequence[Sequence[_Unit]], makes_sense: Callable[[float], bool]
) -> Iterator[_Unit]:
    for group in groups:
        for name, factor in group:
            if all(makes_sense(value * factor) for value in given):
                yield name, factor
                break


def allowed_by(field: FieldInfo) -> Callable[[float], bool]:
    """Return whether a number is within the bounds of a field or, for a list, within the bounds of its entries."""
    bounds = list(_bounds(field))

    def keeps(value: float) -> bool:
        return all(
            getattr(bound, "gt", -math.inf) < value < getattr(bound, "lt", math.inf)
            and getattr(bound, "ge", -math.inf) <= value <= getattr(bound, "le", math.inf)
            for bound in bounds
        )

    return keeps


def _bounds(annotated: Any) -> Iterator[Any]:
    """Yield the bounds in the metadata of a field or type, and of the types within it."""
    inner = [annotated.annotation] if isinstance(annotated, FieldInfo) else get_args(annotated)
    for each in (*getattr(annotated, "metadata", ()), *getattr(annotated, "__metadata__", ())):
        yield from _bounds(each) if isinstance(each, FieldInfo) else [each]
    for each in inner:
        if get_args(each):
            yield from _bounds(each)
