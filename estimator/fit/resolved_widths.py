"""The narrowest smoothed Coulomb step that a simulation resolves.

On a light arm, friction stops a joint within microseconds, which limits the width that can be resolved. A step narrower
than this limit has no visible effect in any recording, but the simulation jumps back and forth across it, which makes
the derivatives meaningless.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import joint_of, term_of
from hil.estimator.simulation.arm import MAX_SUBSTEPS


def resolved_widths(
    names: Sequence[str],
    parameters: Mapping[str, float],
    longest_step: float,
    widths_per_substep: float,
    max_substeps: int = MAX_SUBSTEPS,
) -> Array:
    """Return lower bounds of the widths [rad/s], 0 for other parameters (parameters,).

    Args:
        names: names of the parameters.
        parameters: approximate base parameters and Coulomb friction by name [SI].
        longest_step: integration step far from standstill [s].
        widths_per_substep: see `CoordinateOptions`.
        max_substeps: maximum number of substeps into which a step is divided near standstill.
    """
    values = {name: abs(value) for name, value in parameters.items()}
    inertias = Physics.of(values).free_inertias()
    widths = np.zeros(len(names))
    for index, name in enumerate(names):
        if term_of(name).range == "floor":
            joint = joint_of(name) or 1
            reversal = 2.0 * values[f"coulomb_{joint}"] / max(inertias[joint - 1], 1e-12)
            widths[index] = reversal * longest_step / max_substeps / widths_per_substep
    return widths
