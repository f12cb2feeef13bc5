"""Distance from the point where a fit ended to the minimum."""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import ChainCoordinates
from hil.estimator.fit.bounded_step import bounded_step
from hil.estimator.fit.levenberg_marquardt import Minimum
from hil.estimator.options import MinimiserOptions

MINIMISER = MinimiserOptions()


def remaining(minimum: Minimum, coordinates: ChainCoordinates) -> tuple[Array, float]:
    """Return the undamped step from `minimum` (coordinates,) and the decrease that the normal equations predict for it.

    If the sum of squares is slightly discontinuous, all damped steps may fail although the gradient is not zero.
    """
    at, least = minimum.at, np.full(minimum.x.size, -np.inf)
    # To first order, a decrease of 1 in a logarithm takes the parameter to 0.
    lowest = np.where(coordinates.positive, -1.0, -np.inf)
    least[: len(coordinates.names)] = np.maximum(coordinates.room_below(minimum.x), lowest)
    scale = np.sqrt(np.diag(at.normal))
    scale = np.maximum(scale, 1e-12 * scale.max())
    matrix = at.normal / np.outer(scale, scale)
    matrix[np.diag_indices_from(matrix)] += MINIMISER.min_damping
    step = bounded_step(matrix, at.gradient / scale, least * scale, np.full(least.size, np.inf)) / scale
    return step, -float(step @ (2.0 * at.gradient + at.normal @ step))
