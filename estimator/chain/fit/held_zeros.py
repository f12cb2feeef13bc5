"""Score test of encoder zeros that a fit held fixed.

The sum of squares is evaluated once more at the minimum, with the zeros among its coordinates. One step of its normal
equations estimates the zeros and how much fitting them would lower the sum (Rao's score test).
"""

from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import SMALL, kind_of
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.remaining import remaining
from hil.estimator.fit.levenberg_marquardt import Minimum


@dataclass(frozen=True)
class HeldZeros:
    """Encoder zeros of all joints but the first, as far as the recording determines them."""

    shift: Array
    """Estimated zero errors, true minus measured angle (joints - 1,) [rad]; near 0 if gravity does not reveal them."""
    gain: float
    """Expected decrease in the sum of squares if the zeros were fitted, in units of the white-noise variance."""


def held_zeros(problem: ChainProblem, x: Array, unfinished: float) -> HeldZeros:
    """Estimate the encoder zeros that `problem` holds at 0. x: the minimum of `problem`.

    unfinished: expected decrease in the sum of squares from one more step without fitting the zeros.
    """
    model = replace(problem.model, zeros=True)
    names, size = model.names, len(model.names)
    zeros = np.array([kind_of(name) == "zero" for name in names])
    known = np.concatenate((~zeros, np.ones(x.size - problem.count, dtype=bool)))
    at = np.zeros(known.size)
    at[known] = x
    scales = np.ones(size)
    scales[~zeros] = problem.coordinates.scales
    coordinates = replace(problem.coordinates, names=names, scales=scales)
    free = replace(problem, model=model, coordinates=coordinates)
    step, decrease = remaining(Minimum(at, free.evaluate(at), 1), coordinates)
    return HeldZeros(step[:size][zeros] * SMALL["zero"], max(0.0, decrease - unfinished))
