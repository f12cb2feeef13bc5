"""Standard errors of a chain's fit, from the noise at the frequencies where the fit reads the motion.

Rounding of a moving joint is not white: fast sawteeth put its power above the few hertz of the motion, where the
parameters are read. How much is left there is measured. At frequency f the fit has taken up the share h(f) of the
noise, the leverage of its Jacobian, so that the residual's power there is the noise's times 1 - h. Each joint's level
is the mean over frequencies weighted by leverage; for errors of a model, which are slow, it is far above that of white
noise. Short recordings leave few degrees of freedom to measure it by: the joints' mean level and white noise count as
some more. The covariance is the sandwich N^-1 S N^-1 with S the sum over joints of level times information.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from hil.estimator.arrays import Array
from hil.estimator.chain.objective import ChainProblem

MOST_SAMPLES = 1 << 13  # of a period: enough to know a level to a tenth
SUPPOSED = 20.0  # degrees of freedom of white noise, and of all joints' level, in each one's


def noise_levels(problem: ChainProblem, x: Array, normal: Array) -> tuple[Array, Array]:
    """Variance of each joint's noise (joints,) where the fit reads it, in units of the weights, and each joint's part
    of the information (joints, coordinates, coordinates)."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    factor = cho_factor(normal / np.outer(scale, scale) + 1e-12 * np.eye(len(normal)))
    joints = problem.model.joints
    power, expected, spread = np.zeros((3, joints))
    information = np.zeros((joints, len(x), len(x)))
    for index, period in enumerate(problem.periods):
        for joint, (residual, jacobian) in enumerate(problem.weighted(x, index, MOST_SAMPLES)):
            information[joint] += jacobian.T @ jacobian * (period.samples / len(residual))
            lines = np.fft.rfft(jacobian / scale, axis=0)
            share = np.minimum(_leverage(lines, factor) / len(residual), 1.0)
            power[joint] += float(share @ np.abs(np.fft.rfft(residual)) ** 2) / len(residual)
            expected[joint] += float(share @ (1.0 - share))
            spread[joint] += float(share**2 @ (1.0 - share))
    freedom = 2.0 * expected**2 / np.maximum(spread, 1e-300)
    level = power / np.maximum(expected, 1e-300)
    common = (float(freedom @ level) + SUPPOSED) / (float(freedom.sum()) + SUPPOSED)
    found: Array = (freedom * level + SUPPOSED * common) / (freedom + SUPPOSED)
    return found, information


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
