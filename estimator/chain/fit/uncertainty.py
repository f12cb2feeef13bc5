"""Standard errors of a chain's fit, from the noise at the frequencies that determine the parameters.

Rounding errors of a moving joint are not white: they form a fast sawtooth with most of its power above the few hertz
that determine the parameters. The noise at these low frequencies is estimated from the residual. At frequency f the fit
absorbs the fraction h(f) of the noise, the leverage of its Jacobian, so the power of the residual is that of the noise
times 1 - h. The noise level of a joint is the mean over frequencies weighted by leverage; for model errors, which are
slow, it is far above that of white noise. Since short recordings have few degrees of freedom, each level is shrunk
towards the mean level of all joints, and this mean towards the level of white noise. The same level is assumed at
frequencies where the fit absorbs nearly all noise and the residual therefore reveals nothing about its level. There,
the power of rounding errors is no larger than at higher frequencies, since the observer suppresses their slow part. The
covariance is the sandwich N^-1 S N^-1, where S sums the information of each frequency times the noise there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.resolved_widths import free_inertias
from hil.estimator.chain.model.late_torque import lost_inertia, rotor
from hil.estimator.simulation.back_emf import neglected_inertia

MOST_SAMPLES = 1 << 13  # number of a period's samples to use; enough to estimate a noise level to within 10 %
SUPPOSED = 10.0  # degrees of freedom assumed for a noise level towards which others are shrunk


def coloured_covariance(problem: ChainProblem, x: Array, normal: Array) -> Array:
    """Return the covariance (coordinates, coordinates) at the minimum `x`, where the normal matrix is `normal`."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    lengths = np.outer(scale, scale)
    inverse = linalg.pinv(normal / lengths, hermitian=True)
    seen, middle = np.zeros((2, *normal.shape))
    parts = [part for index in range(len(problem.periods)) for part in _spectra(problem, x, index, scale, inverse)]
    levels = _levels(parts, problem.model.joints)
    for part in parts:
        information = part.information()
        seen += information
        middle += levels[part.joint] * information
    # The rest of the normal matrix is the contribution of the prior.
    covariance: Array = inverse @ (normal / lengths - seen + middle) @ inverse / lengths
    return covariance


def neglected_covariance(problem: ChainProblem, x: Array) -> Array:
    """Return the covariance (parameters, parameters) [SI] due to effects neglected in the model of a lagging back-EMF.

    See `hil.estimator.simulation.back_emf.neglected_inertia`; the joints' errors are independent.
    """
    base, parameters = problem.model.base, problem.parameters(x)
    total = np.zeros((problem.count, problem.count))
    lost = lost_inertia(base, parameters)
    if lost:
        inertia = free_inertias(problem, parameters)
        for joint, each in lost.items():
            brake = parameters[f"back_emf_{joint + 1}"] * parameters[f"viscous_{joint + 1}"]
            std = neglected_inertia(brake, each, float(inertia[joint]), parameters.get("delay", 0.0))
            wrong = std * rotor(base, joint)
            total[: base.count, : base.count] += np.outer(wrong, wrong)
    return total


@dataclass(frozen=True)
class _Spectrum:
    """One joint's Jacobian and residual in one period, by frequency."""

    joint: int
    lines: NDArray[np.complex128]
    """Jacobian for scaled coordinates (frequencies, coordinates), normalised as in an orthonormal real Fourier
    transform.
    """
    power: Array
    """Power of the residual (frequencies,); 1 for white noise with the variance that the weights assume."""
    share: Array
    """Leverage: fraction of the noise at each frequency that the fit absorbs (frequencies,)."""
    stands_for: float
    """Ratio of the period's number of samples to the number used for the Jacobian."""

    def information(self) -> Array:
        """Return the information under white noise, summed over frequencies (coordinates, coordinates)."""
        total: Array = self.stands_for * (self.lines.real.T @ self.lines.real + self.lines.imag.T @ self.lines.imag)
        return total


def _spectra(problem: ChainProblem, x: Array, index: int, scale: Array, inverse: Array) -> Iterator[_Spectrum]:
    samples = problem.periods[index].samples
    for joint, (residual, jacobian) in enumerate(problem.weighted(x, index, MOST_SAMPLES)):
        count = len(residual)
        once = np.full(count // 2 + 1, np.sqrt(2.0 / count))  # all lines but the first and last count twice
        once[0] = np.sqrt(1.0 / count)
        if count % 2 == 0:
            once[-1] = once[0]
        lines = np.fft.rfft(jacobian / scale, axis=0) * once[:, None]
        taken = sum(np.einsum("fc,cd,fd->f", part, inverse, part, optimize=True) for part in (lines.real, lines.imag))
        share = np.clip(taken / np.where(once == once[0], 1.0, 2.0), 0.0, 1.0)
        power = np.abs(np.fft.rfft(residual)) ** 2 / count
        yield _Spectrum(joint, lines, power, share, samples / count)


def _levels(parts: Sequence[_Spectrum], joints: int) -> Array:
    """Return each joint's noise level (joints,) at the frequencies that determine the parameters; 1 for white noise."""
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
