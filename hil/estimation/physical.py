"""Masses, centres of mass and inertias of a result, from its base parameters and [known]."""

from collections.abc import Mapping

import numpy as np

from hil.estimator.models.physical_parameters import QUANTITY_UNITS, Known, physical_quantities
from hil.estimator.models.terms import RIGID_BODY
from hil.results.parts import Physical, PhysicalQuantity
from hil.results.result import Result


def physical_of(result: Result, known: Mapping[str, Known], gravity: float) -> Physical:
    """Masses, centres of mass and inertias of the arm in `result`. Raises ModelError."""
    rigid = [result.covariance.names.index(name) for name in RIGID_BODY[result.joints]]
    covariance = result.covariance.array()[np.ix_(rigid, rigid)]
    base = {name: result.parameters[name].value for name in RIGID_BODY[result.joints]}
    found = physical_quantities(base, covariance, known, gravity, result.joints)
    return Physical(
        {
            name: PhysicalQuantity(value, found.std[name], unit_of(name), name in known)
            for name, value in found.value.items()
        },
        tuple(tuple(group) for group in found.groups),
        tuple(found.doubts),
    )


def unit_of(name: str) -> str:
    """SI unit of the quantity with this name."""
    return QUANTITY_UNITS[name.rsplit("_", 1)[0]]


def physical_lines(physical: Physical) -> list[str]:
    """The quantities as text, one per line."""
    lines = ["Masses, centres and inertias, using the known quantities:"]
    for name, found in physical.quantities.items():
        error = "known" if found.known and found.std == 0.0 else f"+- {found.std:.1e}"
        lines.append(f"  {name:15s} {found.value:11.5g} {found.unit:7s} {error}")
    for group in physical.not_told_apart:
        lines.append(
            f"  not separately identifiable: {', '.join(group)}. Measure one of them and add it under [known]."
        )
    lines.extend(f"  Doubt: {doubt}." for doubt in physical.doubts)
    return lines
