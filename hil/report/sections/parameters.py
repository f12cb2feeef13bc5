"""Parameters with their intervals, what each is, and on a fake arm the truth."""

import math
from collections.abc import Mapping

from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number, percent
from hil.results.parts import Quantity

TWO_SIDED_95 = 1.96
_MEANING = {
    "inertia": "all that the joint turns",
    "coupling": "how link 2's weight hangs on link 1",
    "armature": "rotor through the gears",
    "gravity": "weight, arm level",
    "viscous": "friction per speed",
    "coulomb": "dry friction",
    "offset": "constant torque",
    "coulomb_width": "width of the dry friction's step",
    "stribeck_rise": "more dry friction at low speed",
    "stribeck_velocity": "speed where that has fallen off",
    "load": "friction per torque",
    "presliding_stiffness": "how dry friction yields before it slides",
    "presliding_damping": "of that yielding",
    "viscous_asymmetry": "more friction one way",
    "ripple_sin": "torque ripple over the angle",
    "ripple_cos": "torque ripple over the angle",
    "ripple_cycles": "of it per turn",
    "zero": "error of the zero angle",
    "torque_scale": "true over supposed torque, against joint 1",
    "lag": "of the current loop",
    "delay": "of the torque",
}


def parameters(data: RunData) -> Section:
    """Always there."""
    result = data.result
    tables = [_table(result.parameters, result.truth or {}, "Base parameters")]
    if result.extra:
        tables.append(_table(result.extra, {}, "What the model needed beside them"))
    words = (
        "The interval is what the noise of this one recording leaves open. It holds neither the error of the torque "
        "constants, with which all values of a joint scale, nor what the model lacks.",
    )
    return Section("parameters", "Parameters", words, tuple(tables))


def _table(entries: Mapping[str, Quantity], truth: Mapping[str, float], caption: str) -> Table:
    head = ("parameter", "what it is", "unit", "value", "95 % interval", "rel. error", *(("truth",) if truth else ()))
    return Table(head, tuple(_row(name, entry, truth) for name, entry in entries.items()), 3, caption, 1)


def _row(name: str, entry: Quantity, truth: Mapping[str, float]) -> tuple[str, ...]:
    value, std = entry.value, entry.std
    known = (number(truth[name]) if name in truth else "",) if truth else ()
    unit = "" if entry.unit == "1" else entry.unit.replace("^2", "²")
    meaning = _MEANING.get(name.rstrip("0123456789").rstrip("_"), "")
    if not math.isfinite(std):
        return (name, meaning, unit, number(value), "not determined", "", *known)
    relative = percent(std / abs(value)) if value else ""
    return (name, meaning, unit, *_interval(value, std), relative, *known)


def _interval(value: float, std: float) -> tuple[str, str]:
    """Value and half-width with as many decimals as the width has two digits that count."""
    width = TWO_SIDED_95 * std
    if width <= 0:
        return number(value), "exact"
    decimals = max(0, 1 - math.floor(math.log10(width)))
    if decimals > 9:
        return number(value), f"± {width:.1e}".replace("-", "\u2212")
    return f"{value:.{decimals}f}".replace("-", "\u2212"), f"± {width:.{decimals}f}"
