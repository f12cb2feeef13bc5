"""Standard errors of a chain's fit, from the noise at the frequencies where the fit reads the motion.

Rounding of a moving joint is not white: fast sawteeth put its power above the few hertz of the motion, where the
parameters are read. How much is left there is measured. At frequency f the fit has taken up the share h(f) of the
noise, the leverage of its Jacobian, so that the residual's power there is the noise's times 1 - h. Each joint's level
is the mean over frequencies weighted by leverage; for errors of a model, which are slow, it is far above that of white
noise. Short recordings leave few degrees of freedom to measure it by: the joints' mean level and white noise count as
some more. Where the fit takes up nearly all, as at frequency zero, nothing is measured, and the noise is taken as
white. The covariance is the sandwich N^-1 S N^-1, S the information of each frequency times the noise there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.objective import ChainProblem

MOST_SAMPLES = 1 << 13  # of a period: enough to know a level to a tenth
SUPPOSED = 10.0  # degrees of freedom of white noise, and of all joints' level, in each one's


def coloured_covariance(problem: ChainProblem, x: Array, normal: Array) -> Array:
    """Covariance of all coordinates (coordinates, coordinates) at the minimum `x` with this normal matrix."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    lengths = np.outer(scale, scale)
    inverse = np.linalg.pinv(normal / lengths, hermitian=True)
    seen, middle = np.zeros((2, *normal.shape))
    parts = [part for index in range(len(problem.periods)) for part in _spectra(problem, x, index, scale, inverse)]
    levels = _levels(parts, problem.model.joints)
    for part in parts:
        noise = levels[part.joint] + part.share**2 * (1.0 - levels[part.joint])
        seen += part.information(np.ones_like(noise))
        middle += part.information(noise)
    # What the data do not account for in the normal matrix is the prior's.
    covariance: Array = inverse @ (normal / lengths - seen + middle) @ inverse / lengths
    return covariance


@dataclass(frozen=True)
class _Spectrum:
    """One joint's Jacobian and residual in one period, by frequency."""

    joint: int
    lines: NDArray[np.complex128]
    """Of the Jacobian by scaled coordinates (lines, coordinates), as a real and orthonormal transform has them."""
    power: Array
    """Of the residual (lines,), 1 for white noise of the weights' variance."""
    share: Array
    """Leverage (lines,)."""
    stands_for: float
    """How many times as many samples there are."""

    def information(self, noise: Array) -> Array:
        """Sum over frequencies of the information times the noise (lines,) there."""
        weighted = self.lines * noise[:, None]
        total: Array = self.stands_for * (self.lines.real.T @ weighted.real + self.lines.imag.T @ weighted.imag)
        return total


def _spectra(problem: ChainProblem, x: Array, index: int, scale: Array, inverse: Array) -> Iterator[_Spectrum]:
    samples = problem.periods[index].samples
    for joint, (residual, jacobian) in enumerate(problem.weighted(x, index, MOST_SAMPLES)):
        count = len(residual)
        once = np.full(count // 2 + 1, np.sqrt(2.0 / count))  # every line but the ends stands for two
        once[0] = np.sqrt(1.0 / count)
        if count % 2 == 0:
            once[-1] = once[0]
        lines = np.fft.rfft(jacobian / scale, axis=0) * once[:, None]
        taken = sum(np.einsum("fc,cd,fd->f", part, inverse, part, optimize=True) for part in (lines.real, lines.imag))
        share = np.clip(taken / np.where(once == once[0], 1.0, 2.0), 0.0, 1.0)
        power = np.abs(np.fft.rfft(residual)) ** 2 / count
        yield _Spectrum(joint, lines, power, share, samples / count)


def _levels(parts: Sequence[_Spectrum], joints: int) -> Array:
    """Of each joint's noise (joints,) where the fit reads it, 1 if it is white."""
    power, expected, spread = np.zeros((3, joints))
    for part in parts:
        power[part.joint] += float(part.share @ part.power)
        expected[part.joint] += float(part.share @ (1.0 - part.share))
        spread[part.joint] += float(part.share**2 @ (1.0 - part.share))
    freedom = 2.0 * expected**2 / np.maximum(spread, 1e-300)
    level = power / np.maximum(expected, 1e-300)
    common = (float(freedom @ level) + SUPPOSED) / (float(freedom.sum()) + SUPPOSED)
    found: Array = (freedom * level + SUPPOSED * common) / (freedom + SUPPOSED)
    return found
