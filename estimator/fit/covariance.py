"""Standard errors, from the sandwich N^-1 S N^-1, that remain valid if the residual is not white.

N = J'WJ is the information, and S the scatter of the score J'Wr; for independent errors, S = N. Rounding errors of a
slow joint, and model errors, are correlated between samples. S allows for this if the products of scores are also
summed over lags (Newey and West, Econometrica 55 (1987) 703). With Bartlett's kernel and L lags, S equals the sum, over
all windows of L samples, of the outer product of the window's score with itself, divided by L.

Model errors are not only correlated: they repeat at every reversal, so averaging does not remove them, and any part
that resembles the effect of a parameter leaves no residual at all. Therefore the non-white part of the residual widens
the standard errors further: 1.4 standard errors cover every change in the parameters that alters the motion (RMS) by no
more than this non-white part (a set-membership bound; Milanese and Vicino, Automatica 27 (1991) 997).
"""

from collections.abc import Sequence

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.fit.levenberg_marquardt import Quadratic
from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.options import CovarianceOptions

DEFAULTS = CovarianceOptions()
FAINT_PRIOR = 1e-4  # fraction of a prior's precision that is kept, so that unmeasured coordinates have finite variances
SENSITIVE = 1e7  # largest RMS change of the samples, in units of the noise, per unit change of a coordinate
LEAST_INFORMATION = 1e-13  # information on a combination of coordinates, relative to each alone; less is rounding error
VANISHED = 1e-3  # ratio of slope to value below which a parameter has run into its floor


class Scatter:
    """Accumulates S from a score (samples, coordinates), passed piece by piece, over windows of `lags` samples."""

    def __init__(self, causes: int, lags: int) -> None:
        self._lags = lags
        self._before = np.zeros((lags - 1, causes))
        self._total = np.zeros((causes, causes))

    def add(self, score: Array) -> None:
        """Add the score of the next samples (samples, coordinates)."""
        extended = np.concatenate((self._before, score))
        self._before = extended[extended.shape[0] - (self._lags - 1) :]
        self._add_windows(extended)

    def sum(self) -> Array:
        """Return S (coordinates, coordinates), including the last, incomplete windows."""
        self._add_windows(np.concatenate((self._before, np.zeros_like(self._before))))
        return self._total

    def _add_windows(self, score: Array) -> None:
        gathered = np.concatenate((np.zeros((1, score.shape[1])), np.cumsum(score, axis=0)))
        windows = gathered[self._lags :] - gathered[: -self._lags]
        if len(windows):
            self._total += normal_equations(windows, np.zeros(len(windows)))[0] / self._lags


def correlation_time(residuals: Sequence[Array], options: CovarianceOptions = DEFAULTS) -> int:
    """Return twice the lag [samples] beyond which no residual (joints, samples) of any run is autocorrelated.

    That lag is the first at which the autocorrelation falls into the range expected of white noise.
    """
    longest = options.min_lag
    for residual in residuals:
        samples = residual.shape[1]
        most = min(options.max_lag, int(options.max_lag_share * samples))
        for row in residual:
            rho = autocorrelation(row, most)
            inside = np.nonzero(np.abs(rho[1:]) < 2.0 / np.sqrt(samples))[0]
            longest = max(longest, 2 * (int(inside[0]) + 1 if inside.size else most))
    return min(longest, options.max_lag)


def structured_share(residual: Array) -> Array:
    """Return the fraction (joints,) of the power of each residual (joints, samples) that is not white.

    The level of white noise is estimated from the upper half of the spectrum, far above the frequencies of the motion.
    The fraction is 0 if the residual does not differ significantly from white noise.
    """
    samples = residual.shape[1]
    power = np.abs(np.fft.rfft(residual, axis=1)) ** 2 / samples**2
    upper = power[:, power.shape[1] // 2 :].mean(axis=1) * samples
    total = np.mean(residual**2, axis=1)
    chance = 1.0 + 4.0 / np.sqrt(samples / 4.0)
    share: Array = np.clip(1.0 - chance * upper / np.maximum(total, 1e-300), 0.0, 1.0)
    return share


def autocorrelation(residual: Array, lags: int) -> Array:
    """Return the autocorrelation of one residual (samples,) at 0 to `lags` samples (lags + 1,)."""
    centred = residual - residual.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
    product = np.fft.irfft(spectrum)[: lags + 1]
    rho: Array = product / max(product[0], 1e-300)
    return rho


def robust_covariance(
    at: Quadratic,
    scatter: Array | None,
    samples: int,
    count: int,
    structured: float = 0.0,
    expected: Array | None = None,
) -> Array:
    """Return the covariance of the first `count` coordinates (count, count), treating all coordinates as unknown.

    In every direction, it is the larger of the sandwich and the covariance for independent errors, since a short
    recording cannot prove that its errors cancel. It is infinite for a coordinate without influence on the residual.

    Args:
        at: the sum of squares at the minimum.
        scatter: scatter of the score; without it, errors are assumed independent with variance 1.
        samples: number of samples.
        count: number of coordinates to return.
        structured: part of the sum of squares that is due to model errors.
        expected: contribution of a prior to the normal equations (coordinates, coordinates); it is not reduced where
            the data's variance is inflated.
    """
    if is_unpredictable(at, samples):
        return np.full((count, count), np.inf)
    prior = np.zeros_like(at.normal) if expected is None else (1.0 - FAINT_PRIOR) * expected
    seen, lengths, _, found = _measured(at, scatter, samples, structured, prior)
    covariance = np.zeros_like(at.normal)
    if prior.any():
        size, directions = linalg.eigh(prior[np.ix_(seen, seen)] / lengths)
        root = directions * np.sqrt(np.maximum(size, 0.0))
        # (found^-1 + prior)^-1 without inverting a matrix that may be nearly singular.
        inner = np.eye(len(found)) + root.T @ found @ root
        found = found - found @ root @ linalg.solve(inner, root.T @ found)
    covariance[np.ix_(seen, seen)] = found / lengths
    hidden = np.flatnonzero(~seen)
    covariance[hidden, hidden] = np.inf
    return covariance[:count, :count]


def is_unpredictable(at: Quadratic, samples: int) -> bool:
    """Return whether the motion is so sensitive that its derivatives are valid only for extremely small changes.

    If so, the computed standard errors are tiny and meaningless. Coordinates are of order 1.
    """
    return bool(np.max(np.diag(at.normal), initial=0.0) > (samples * SENSITIVE**2))


def inflation(at: Quadratic, scatter: Array | None, samples: int, structured: float, expected: Array) -> Array:
    """Return the ratio (coordinates,) of each coordinate's variance to that for independent errors.

    Both variances are from the data alone; the first includes what `robust_covariance` adds for correlated errors and
    model errors. Arguments as in `robust_covariance`.
    """
    if is_unpredictable(at, samples):
        return np.ones(len(at.normal))
    seen, _, inverse, found = _measured(at, scatter, samples, structured, (1.0 - FAINT_PRIOR) * expected)
    factor = np.ones(len(at.normal))
    factor[seen] = np.maximum(np.diag(found) / np.maximum(np.diag(inverse), 1e-300), 1.0)
    return factor


def _measured(
    at: Quadratic, scatter: Array | None, samples: int, structured: float, prior: Array
) -> tuple[Mask, Array, Array, Array]:
    """Return a mask, a scale, and two covariances from the data alone: one for independent errors, and a robust one.

    The mask selects the coordinates that influence the residual. The covariances cover only these and are relative to
    the scale.
    """
    norm = np.sqrt(np.diag(at.normal))
    seen: Mask = norm > 1e-12 * norm.max()
    lengths = np.outer(norm[seen], norm[seen])
    measured = (at.normal - prior)[np.ix_(seen, seen)] / lengths
    inverse = _inverse(measured)
    if scatter is None:
        return seen, lengths, inverse, inverse
    freedom = max(1, samples - int(seen.sum()))
    scores = (scatter - prior)[np.ix_(seen, seen)] / lengths
    robust = inverse @ scores @ inverse * (samples / freedom)
    found = larger_covariance(np.asarray(robust, dtype=np.float64), at.cost / freedom * inverse)
    return seen, lengths, inverse, found + 0.5 * structured * inverse


def _inverse(information: Array) -> Array:
    """Return the inverse of a matrix whose diagonal elements are at most 1.

    If only a combination of some coordinates matters, an eigenvalue is zero except for rounding. A pseudoinverse would
    treat their other combinations, which are unknown, as known exactly.
    """
    size, directions = linalg.eigh(information)
    inverse: Array = (directions / np.maximum(size, LEAST_INFORMATION)) @ directions.T
    return inverse


def larger_covariance(robust: Array, white: Array) -> Array:
    """Return a covariance that is at least as large as both `robust` and `white` in every direction."""
    size, directions = linalg.eigh(white)
    root = directions * np.sqrt(np.maximum(size, 1e-300))
    ratio = linalg.solve(root, linalg.solve(root, robust).T)
    factor, turned = linalg.eigh(0.5 * (ratio + ratio.T))
    covariance: Array = (root @ (turned * np.maximum(factor, 1.0))) @ (root @ turned).T
    return covariance


def by_parameters(covariance: Array, slopes: Array, value: Array, floored: Mask | None = None) -> Array:
    """Return the covariance of the parameters (parameters, parameters) from that of their coordinates.

    A parameter that has run into its floor is practically zero, and its own value serves as its standard error. It is
    recognised by its slope, which equals the distance from the floor, since the coordinate is the logarithm of this
    distance.

    floored: which parameters (parameters,) have a floor; by default none.
    """
    hidden = np.isinf(np.diag(covariance))
    finite: Array = slopes @ np.where(np.isfinite(covariance), covariance, 0.0) @ slopes.T
    finite[hidden, hidden] = np.inf
    if floored is not None:
        faint = hidden & floored & (np.diag(slopes) < VANISHED * np.abs(value))
        finite[faint, faint] = value[faint] ** 2
    return finite
