"""Identified values of a spatial arm that contradict its description, its configuration or typical servo parameters."""

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import ANGLES, SHAPES, kind_of
from hil.estimator.chain.model.prior import Prior
from hil.estimator.models.conflicts import Conflict, Source, conflict, worst_first

DRIVES = ("back_emf", "lag_ratio")
"""Drive terms that are compared with typical values. The other terms of `SHAPES` are not, since they may be zero."""


def chain_conflicts(names: tuple[str, ...], value: Array, std: Array, prior: Prior) -> tuple[Conflict, ...]:
    """Return the parameters that contradict prior knowledge, worst first; `names` begins with the base parameters."""
    precision = prior.scale_precision
    scales = np.empty(0) if precision is None else np.sqrt(np.diag(linalg.inv(precision)))
    found: list[Conflict | None] = []
    for index, (name, each, error) in enumerate(zip(names, value.tolist(), std.tolist(), strict=True)):
        kind = kind_of(name)
        if index < prior.value.size:
            expected, spread = float(prior.value[index]), float(prior.std[index])
            found.append(conflict(name, each, error, expected, spread, relative=False, source="description"))
        elif kind in DRIVES:
            found.append(conflict(name, each, error, *SHAPES[kind], relative=True))
        elif kind in ANGLES:
            source: Source | None = "file" if kind.startswith("base_tilt") else None
            found.append(conflict(name, each, error, 0.0, ANGLES[kind], relative=False, source=source))
        elif kind == "torque_scale" and scales.size:
            spread = float(scales[int(name.rpartition("_")[2]) - 2])
            found.append(conflict(name, each, error, 1.0, spread, relative=True))
    return worst_first(found)
