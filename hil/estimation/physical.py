"""Masses, centres and inertias of a result, from its base parameters and what [known] says."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hil.estimator.models.physical_parameters import QUANTITY_UNITS, Known, physical_quantities
from hil.estimator.models.terms import RIGID_BODY


def physical_entries(result: Mapping[str, Any], known: Mapping[str, Known], gravity: float) -> dict[str, Any]:
    """The entry `physical` of a result: quantities (value, std, unit), not_told_apart, doubts. Raises ModelError."""
    joints = int(result["joints"])
    names = list(result["covariance"]["names"])
    rigid = [names.index(name) for name in RIGID_BODY[joints]]
    covariance = np.array(result["covariance"]["matrix"])[np.ix_(rigid, rigid)]
    base = {name: float(result["parameters"][name]["value"]) for name in RIGID_BODY[joints]}
    found = physical_quantities(base, covariance, known, gravity, joints)
    return {
        "quantities": {
            name: {"value": value, "std": found.std[name], "unit": unit_of(name), "known": name in known}
            for name, value in found.value.items()
        },
        "not_told_apart": [list(group) for group in found.groups],
        "doubts": list(found.doubts),
    }


def unit_of(name: str) -> str:
    """SI unit of a quantity by its name."""
    return QUANTITY_UNITS[name.rsplit("_", 1)[0]]


def physical_lines(entries: Mapping[str, Any]) -> list[str]:
    """The same in words, a line each."""
    lines = ["Masses, centres and inertias with what is known:"]
    for name, item in entries["quantities"].items():
        error = "known" if item["known"] and item["std"] == 0.0 else f"+- {item['std']:.1e}"
        lines.append(f"  {name:15s} {item['value']:11.5g} {item['unit']:7s} {error}")
    for group in entries["not_told_apart"]:
        lines.append(f"  not told apart: {', '.join(group)}. Measure one of them and add it under [known].")
    lines.extend(f"  Doubt: {doubt}." for doubt in entries["doubts"])
    return lines
