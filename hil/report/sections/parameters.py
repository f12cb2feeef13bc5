"""Section with the parameters: value, interval, meaning and, for a fake arm, the true value."""

import math
from collections.abc import Mapping

from hil.estimation.truth import truth_of
from hil.estimator.chain.model.late_torque import MEANINGS as LATE
from hil.estimator.chain.model.tilt import MEANINGS
from hil.estimator.models.terms import kind_of, term_of
from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number, percent
from hil.results.parts import Quantity
from hil.results.result import Result

TWO_SIDED_95 = 1.96
_MOST_DECIMALS = 9


def parameters(data: RunData) -> Section:
    truth = truth_of(data.result, data.config)
    return parameters_of(data.result, truth.values, truth.note)


def parameters_of(result: Result, truth: Mapping[str, float] | None = None, note: str = "") -> Section:
    """Return the section on parameters for any kind of result. truth: true values in the result's units. note: a
    sentence about them.
    """
    groups = {} if result.chain is None else result.chain.groups
    tables = [_table(result.parameters, truth or {}, groups, "Base parameters")]
    if result.extra:
        tables.append(_table(result.extra, {}, {}, "Additional model terms"))
    left_out = ", and small effects that the model leaves out and the motion cannot rule out"
    words = (
        f"The interval covers the noise of this recording{left_out if result.chain is None else ''}. It includes "
        "neither the error of a torque constant, to which all values of a joint are proportional, nor other model "
        "errors.",
        *([note] if note else []),
    )
    return Section("parameters", "Parameters", words, tuple(tables))


def _table(
    entries: Mapping[str, Quantity], truth: Mapping[str, float], groups: Mapping[str, str], caption: str
) -> Table:
    """Build a table. groups: composition of a spatial arm's base parameters, by name."""
    head = ("parameter", "meaning", "unit", "value", "95 % interval", "rel. error", *(("truth",) if truth else ()))
    rows = tuple(_row(name, entry, truth, groups) for name, entry in entries.items())
    return Table(head, rows, 3, caption, (1, 5) if truth else (1,))


def _row(name: str, entry: Quantity, truth: Mapping[str, float], groups: Mapping[str, str]) -> tuple[str, ...]:
    value, std = entry.value, entry.std
    known = (_as_precise(truth[name], std) if name in truth else "",) if truth else ()
    unit = "" if entry.unit == "1" else entry.unit.replace("^2", "²")
    meaning = groups.get(name) or MEANINGS.get(name) or LATE.get(kind_of(name)) or term_of(name).meaning
    if not math.isfinite(std):
        return (name, meaning, unit, number(value), "not determined", "", *known)
    relative = percent(std / abs(value)) if value else ""
    return (name, meaning, unit, *_interval(value, std), relative, *known)


def _interval(value: float, std: float) -> tuple[str, str]:
    """Value and half-width of the interval, rounded to two significant digits of the half-width."""
    width = TWO_SIDED_95 * std
    if width <= 0:
        return number(value), "exact"
    decimals = _decimals(std)
    if decimals is None:
        return number(value), f"± {width:.1e}".replace("-", "\u2212")
    return _as_precise(value, std), f"± {width:.{decimals}f}"


def _as_precise(value: float, std: float) -> str:
    decimals = _decimals(std)
    return number(value) if decimals is None else f"{value:.{decimals}f}".replace("-", "\u2212")


def _decimals(std: float) -> int | None:
    """Number of decimals that show two digits of the interval's half-width; None if the half-width is too small or
    unknown.
    """
    width = TWO_SIDED_95 * std
    if not (width > 0 and math.isfinite(width)):
        return None
    decimals = max(0, 1 - math.floor(math.log10(width)))
    return decimals if decimals <= _MOST_DECIMALS else None
