"""Standard errors of a chain's fit, from the noise at the frequencies where the fit reads the motion.

Rounding of a moving joint is not white: fast sawteeth put its power above the few hertz of the motion, where the
parameters are read. How much is left there is measured. At frequency f the fit has taken up the share h(f) of the noise,
the leverage of its Jacobian, so that the residual's power there is the noise's times 1 - h. Each joint's level is the
mean over frequencies weighted by leverage; for errors of a model, which are slow, it is far above that of white noise.
The covariance is the sandwich N^-1 S N^-1 with S the sum over joints of level times information.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from hil.estimator.arrays import Array
from hil.estimator.chain.objective import ChainProblem

MOST_SAMPLES = 1 << 13  # of a period: enough to know a level to a tenth
MOST_LEVERAGE = 0.9  # what the fit has taken up wholly says nothing of the noise
LEAST_LEVEL = 0.2  # of white noise: less cannot be told from chance


def noise_levels(problem: ChainProblem, x: Array, normal: Array) -> tuple[Array, Array]:
    """Variance of each joint's noise (joints,) where the fit reads it, in units of the weights, and each joint's part of
    the information (joints, coordinates, coordinates)."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    factor = cho_factor(normal / np.outer(scale, scale) + 1e-12 * np.eye(len(normal)))
    joints = problem.model.joints
    power, taken = np.zeros((2, joints))
    information = np.zeros((joints, len(x), len(x)))
    for index in range(len(problem.periods)):
        for joint, (residual, jacobian) in enumerate(problem.weighted(x, index, MOST_SAMPLES)):
            information[joint] += jacobian.T @ jacobian * (problem.periods[index].samples / len(residual))
            lines = np.fft.rfft(jacobian / scale, axis=0)
            share = _leverage(lines, factor) / len(residual)
            noise = np.abs(np.fft.rfft(residual)) ** 2 / len(residual)
            read = share < MOST_LEVERAGE
            power[joint] += float(np.sum((share * noise / (1.0 - share))[read]))
            taken[joint] += float(np.sum(share[read]))
    return np.maximum(power / np.maximum(taken, 1e-300), LEAST_LEVEL), information


def level_covariance(normal: Array, levels: Array, information: Array) -> Array:
    """Covariance (coordinates, coordinates) where each joint's errors have these levels; the rest of the normal matrix,
    which is the prior's, as it is."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    lengths = np.outer(scale, scale)
    seen = information.sum(axis=0)
    middle = np.tensordot(levels, information, 1) + (normal - seen)
    inverse = np.linalg.pinv(normal / lengths, hermitian=True)
    covariance: Array = inverse @ (middle / lengths) @ inverse / lengths
    return covariance


def _leverage(lines: Array, factor: tuple[Array, bool]) -> Array:
    """Share of the noise in each line that the fit takes up, its real and imaginary parts' mean (lines,)."""
    parts = [np.einsum("fc,cf->f", part, cho_solve(factor, part.T)) for part in (lines.real, lines.imag)]
    share: Array = parts[0] + parts[1]
    return share
