"""Standard errors that remain valid when the residual is not white: the sandwich N^-1 S N^-1.

N = J'WJ is the information, S the scatter of the score J'Wr. Independent errors have S = N; rounding of a slow
joint, and model error, are correlated over samples, which S sees when the score's products are summed
over lags (Newey and West, Econometrica 55 (1987) 703). Bartlett's kernel of L lags is the sum over all windows
of L samples of the window's own score times itself, over L: one pass, whatever L.

Model error is more than correlated: it repeats at every reversal, so that averaging does not remove it,
and the part that resembles a parameter leaves no residual at all. So the part of the residual that is not
white widens the errors further: 1.4 standard deviations reach as far as the parameters can move before the motion
changes, RMS, by as much as that part (a set-membership bound; Milanese and Vicino, Automatica 27 (1991) 997).
"""

from collections.abc import Sequence

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.fit.levenberg_marquardt import Quadratic
from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.options import CovarianceOptions

DEFAULTS = CovarianceOptions()
FAINT_PRIOR = 1e-4  # of a prior's precision, which keeps what is not measured at all finite
VANISHED = 1e-3  # of a parameter's value: its slope when it has run into its floor


class Scatter:
    """Adds up a score (samples, causes), given piece by piece, over windows of `lags` samples."""

    def __init__(self, causes: int, lags: int) -> None:
        self._lags = lags
        self._before = np.zeros((lags - 1, causes))
        self._total = np.zeros((causes, causes))

    def add(self, score: Array) -> None:
        """The next samples."""
        extended = np.concatenate((self._before, score))
        self._before = extended[extended.shape[0] - (self._lags - 1) :]
        self._add_windows(extended)

    def sum(self) -> Array:
        """S (causes, causes), with the last samples' windows closed."""
        self._add_windows(np.concatenate((self._before, np.zeros_like(self._before))))
        return self._total

    def _add_windows(self, score: Array) -> None:
        gathered = np.concatenate((np.zeros((1, score.shape[1])), np.cumsum(score, axis=0)))
        windows = gathered[self._lags :] - gathered[: -self._lags]
        if len(windows):
            self._total += normal_equations(windows, np.zeros(len(windows)))[0] / self._lags


def correlation_time(residuals: Sequence[Array], options: CovarianceOptions = DEFAULTS) -> int:
    """Lags (samples) beyond which no residual (joints, samples) of any run is correlated, times two.

    Where the autocorrelation first falls into the band that white noise would leave it in.
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
    """Fraction (joints,) of the power of each residual (joints, samples) that is not white; 0 if not significantly
    different from white.

    White noise has the same power in every Fourier line; the upper half of the lines, far above the motion, tells
    how much.
    """
    samples = residual.shape[1]
    power = np.abs(np.fft.rfft(residual, axis=1)) ** 2 / samples**2
    upper = power[:, power.shape[1] // 2 :].mean(axis=1) * samples
    total = np.mean(residual**2, axis=1)
    chance = 1.0 + 4.0 / np.sqrt(samples / 4.0)
    share: Array = np.clip(1.0 - chance * upper / np.maximum(total, 1e-300), 0.0, 1.0)
    return share


def autocorrelation(residual: Array, lags: int) -> Array:
    """Autocorrelation of one residual (samples,) at 0 to `lags` samples (lags + 1,)."""
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
    precision: Array | None = None,
) -> Array:
    """Covariance of the first `count` coordinates (count, count), the others unknown with them.

    The larger of the sandwich and of what independent errors would give, direction by direction: a short
    recording cannot prove that its errors cancel. Without `scatter` that of independent errors of variance 1.
    `structured` is the part of the sum of squares that is a model's error. `precision` (coordinates,) is what a prior
    has put into the normal equations: it stays as it is where the errors of measurement are larger than independent
    ones. Infinite for a coordinate without influence on the residual.
    """
    prior = np.zeros(len(at.normal)) if precision is None else (1.0 - FAINT_PRIOR) * precision
    norm = np.sqrt(np.diag(at.normal))
    seen = norm > 1e-12 * norm.max()
    lengths = np.outer(norm[seen], norm[seen])
    measured = (at.normal - np.diag(prior))[np.ix_(seen, seen)] / lengths
    inverse = np.asarray(np.linalg.pinv(measured, hermitian=True), dtype=np.float64)
    freedom = max(1, samples - int(seen.sum()))
    covariance = np.zeros_like(at.normal)
    found = inverse
    if scatter is not None:
        scores = (scatter - np.diag(prior))[np.ix_(seen, seen)] / lengths
        robust = inverse @ scores @ inverse * (samples / freedom)
        found = larger_covariance(np.asarray(robust, dtype=np.float64), at.cost / freedom * inverse)
        found = found + 0.5 * structured * inverse
    if prior.any():
        expected = np.diag(np.sqrt(prior[seen]) / norm[seen])
        # (found^-1 + prior)^-1 without an inverse of what may be hardly seen.
        inner = np.eye(len(found)) + expected @ found @ expected
        found = found - found @ expected @ np.linalg.solve(inner, expected @ found)
    covariance[np.ix_(seen, seen)] = found / lengths
    hidden = np.flatnonzero(~seen)
    covariance[hidden, hidden] = np.inf
    return covariance[:count, :count]


def larger_covariance(robust: Array, white: Array) -> Array:
    """A covariance at least as large as both along the directions in which they differ."""
    size, directions = np.linalg.eigh(white)
    root = directions * np.sqrt(np.maximum(size, 1e-300))
    ratio = np.linalg.solve(root, np.linalg.solve(root, robust).T)
    factor, turned = np.linalg.eigh(0.5 * (ratio + ratio.T))
    covariance: Array = (root @ (turned * np.maximum(factor, 1.0))) @ (root @ turned).T
    return covariance


def by_parameters(covariance: Array, slopes: Array, value: Array) -> Array:
    """Covariance of the parameters (parameters, parameters) from that of their coordinates.

    A positive parameter that leaves no trace is as good as zero: it is known to its own size. Its coordinate is
    the logarithm of what is above its floor, so that the slope is that size.
    """
    hidden = np.isinf(np.diag(covariance))
    finite: Array = slopes @ np.where(np.isfinite(covariance), covariance, 0.0) @ slopes.T
    faint = hidden & (np.diag(slopes) < VANISHED * np.abs(value))
    finite[hidden, hidden] = np.inf
    finite[faint, faint] = value[faint] ** 2
    return finite
