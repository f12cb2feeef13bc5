"""Parameters with their intervals, what each is, and on a fake arm the truth."""

import math
from typing import Any

from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number, percent

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
    "lag": "of the current loop",
    "delay": "of the torque",
}


def parameters(data: RunData) -> Section:
    """Always there."""
    truth = data.result.get("truth", {})
    head = ("parameter", "what it is", "value", "95 % interval", "unit", "rel. error", *(("truth",) if truth else ()))
    tables = [
        Table(head, tuple(_row(name, entry, truth) for name, entry in data.result[key].items()), 2, caption)
        for key, caption in (("parameters", "Base parameters"), ("extra", "What the model needed beside them"))
        if data.result[key]
    ]
    words = (
        "The interval is what the noise of this one recording leaves open. It holds neither the error of the torque "
        "constants, with which all values of a joint scale, nor what the model lacks.",
    )
    return Section("parameters", "Parameters", words, tuple(tables))


def _row(name: str, entry: dict[str, Any], truth: dict[str, float]) -> tuple[str, ...]:
    value, std = entry["value"], entry["std"]
    known = (number(truth[name]) if name in truth else "",) if truth else ()
    meaning = _MEANING.get(name.rstrip("0123456789").rstrip("_"), "")
    if not math.isfinite(std):
        return (name, meaning, number(value), "not determined", entry["unit"], "", *known)
    relative = percent(std / abs(value)) if value else ""
    return (name, meaning, *_interval(value, std), entry["unit"], relative, *known)


def _interval(value: float, std: float) -> tuple[str, str]:
    """Value and half-width with as many decimals as the width has two digits that count."""
    width = TWO_SIDED_95 * std
    if width <= 0:
        return number(value), "exact"
    decimals = max(0, 1 - math.floor(math.log10(width)))
    if decimals > 9:
        return number(value), f"± {width:.1e}".replace("-", "\u2212")
    return f"{value:.{decimals}f}".replace("-", "\u2212"), f"± {width:.{decimals}f}"
