"""Section on how close a spatial arm came to itself and to obstacles, and on the parts that need no margin."""

import numpy as np
from numpy.typing import NDArray

from hil.clearance.doubts import near_by_design, unchecked
from hil.clearance.space import Space
from hil.estimator.arrays import Array
from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.runs.recording import Phase

_LOOKED_AT_HZ = 100.0
_PHASES = (
    ("along the paths", (Phase.PERIODIC,), False),
    ("from and to the rest pose", (Phase.RAMP_IN, Phase.RAMP_OUT, Phase.LOWERING), True),
)


def clearance(data: RunData) -> Section | None:
    """Return the section; None for a planar arm. Raises ArmFileError."""
    if not data.config.is_chain:
        return None
    space = Space.of(data.config)
    rows = [_row(space, name, _poses(data, space, phases), way) for name, phases, way in _PHASES]
    table = Table(("where", "between", "least", "required"), tuple(row for row in rows if row), 2)
    words = ("Least clearance of the recorded motion. In and near the rest pose, the arm may touch what it rests on.",)
    return Section("clearance", "Clearance", words, (table,), bullets=(*near_by_design(space), *unchecked(space)))


def _row(space: Space, name: str, poses: Array, on_the_way: bool) -> tuple[str, ...] | None:
    if not poses.shape[1]:
        return None
    found = space.nearest(poses, on_the_way)
    if not np.isfinite(found.distance):
        return name, "nothing is near", "", ""
    return name, " and ".join(found.pair), _millimetres(found.distance), _millimetres(found.needed)


def _poses(data: RunData, space: Space, phases: tuple[Phase, ...]) -> Array:
    """Poses away from the rest pose (joints, poses) [rad]."""
    every = max(1, round(data.config.experiment.rate / _LOOKED_AT_HZ))
    position: Array = data.samples["position"]
    phase: NDArray[np.uint8] = data.samples["phase"]
    q = position[np.isin(phase, phases)][::every].T
    q = q[:, np.isfinite(q).all(axis=0)]
    return q[:, ~space.lies(q)]


def _millimetres(distance: float) -> str:
    return f"{1e3 * distance:.0f} mm"
