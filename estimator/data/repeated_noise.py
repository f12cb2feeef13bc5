"""Noise of the angles, estimated from the difference between two passes of the same periodic motion.

Everything that repeats with the motion cancels. Without noise, both passes are rounded identically and the difference
is zero; the more noise there is before rounding, the more the rounding errors differ. With independent Gaussian noise
of standard deviation s, a slow drift d from one pass to the next, and angles spread evenly over the steps, half the
mean square of the difference at high frequencies is

    s^2 + 1/12 - sum over k of exp(-(2 pi k s)^2) cos(2 pi k d) / (2 pi^2 k^2)   [steps^2],

where the sum is the part of the rounding error's power 1/12 that repeats (Fourier series of the rounding error; B.
Widrow and I. Kollar, Quantization Noise, 2008). The drift is the difference at low frequencies and is caused by
changing friction. Solving for s gives the error variance of one reading, s^2 + 1/12. It is an upper bound, since other
differences between the passes increase it.

This applies to noise that is white before rounding. The excess of filtered noise at low frequencies is measured from
the same difference (`coloured_noise`).
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.fourier import interpolated_noise, slow_part, white_noise, without_jump

__all__ = ["agreed_noise", "coloured_noise", "repeated_noise"]

FEWEST = 20  # minimum number of samples in a pass; at 20 Hz, half a period of 2 s
ROUNDING = 1.0 / 12.0  # steps^2
AGREE = 2.0  # standard errors
_LINES = 8.0  # a period's noise is measured from one line per this many samples
_LINE_ERROR = 0.72  # relative standard error of the noise from the median power of one line
_STD = np.linspace(0.0, 1.0, 401)
_ORDERS = np.arange(1, 30)
_HEIGHTS = 1.0 / (2.0 * np.pi**2 * _ORDERS**2)
_HEIGHTS *= ROUNDING / _HEIGHTS.sum()  # the series is truncated
_REPEATS = _HEIGHTS * np.exp(-((2.0 * np.pi * _ORDERS * _STD[:, None]) ** 2))
"""Power of the repeating part of each order of the rounding error in the absence of drift, for each value of `_STD`
(stds, orders) [steps^2].
"""
_SLOW = 1.0 / 16.0  # fraction of the lines that drift may occupy
_CHANGE = 0.03  # largest relative change in the motion from pass to pass
_SURE = 3.0  # standard errors by which coloured noise must exceed white noise
_OCTAVE = 4.0  # largest ratio of the powers of noise in successive octaves: that of a first-order filter
_MOST_NOISE = 1.0  # exponent of the correction for noise in the drift; above it, an order counts as decorrelated


def repeated_noise(passes: Sequence[Array], step: Array, averaged: int = 1) -> Array | None:
    """Return the standard deviation of the error of one averaged sample (joints,) [rad], rounding included.

    Args:
        passes: angles (joints, samples) [rad] of successive passes of the same motion; NaN where a sample is missing.
        step: encoder step of each joint (joints,) [rad].
        averaged: number of passes averaged to obtain the sample.

    Returns:
        The standard deviations; None if there are fewer than two passes or the passes are too short.
    """
    if len(passes) < 2 or passes[0].shape[1] < FEWEST:
        return None
    differences = [(later - former) / step[:, None] for former, later in pairwise(passes)]
    differs = 0.5 * np.mean([_power(each) for each in differences], axis=0)
    kept = np.mean([_not_drifted(each, differs) for each in differences], axis=0)
    repeats = np.array([_repeating(*joint) for joint in zip(differs, kept, strict=True)])
    received = np.mean([np.isfinite(each).mean(axis=1) for each in passes], axis=0)
    count = np.maximum(averaged * received, 1.0)
    # Drift by half a step reverses the rounding error between successive passes, but not across all passes.
    noise: Array = step * np.sqrt((differs + repeats) / count + (1.0 - 1.0 / count) * np.maximum(repeats, 0.0))
    return noise


def coloured_noise(passes: Sequence[Array], step: Array, averaged: int = 1) -> Array | None:
    """Return the standard deviation of one averaged sample's noise in excess of white noise (joints,) [rad].

    It is 0 unless significant. At low frequencies, where the motion may have changed from pass to pass, the noise is
    extrapolated: its ratio to the noise in the octave above is assumed to equal the ratio between that octave and the
    next. Noise with a long correlation is underestimated. Takes the arguments of `repeated_noise`, and
    returns None in the same cases.
    """
    if len(passes) < 2 or passes[0].shape[1] < FEWEST:
        return None
    found = [[_excess(*joint) for joint in zip(*each, strict=True)] for each in pairwise(passes)]
    excess, fast = 0.5 * np.mean(found, axis=0).T
    # If most of the rounding error repeats, even small changes in the motion exceed what remains of it.
    known = np.maximum(fast, ROUNDING * step**2)
    error = known * np.sqrt(2.0 * (0.75 + 0.75**2 / 0.25) / passes[0].shape[1])
    noise: Array = np.sqrt(np.where(excess > _SURE * error, excess / averaged, 0.0))
    return noise


def _excess(former: Array, later: Array) -> tuple[float, float]:
    """Return the excess power and the white-noise power in the difference between two passes (samples,).

    The excess is the power beyond that of white noise.
    """
    difference = later - former
    valid = np.isfinite(difference)
    power = _spectrum(without_jump(_filled(difference[None])))
    fast = float(power[0, _fastest(power) :].mean())
    motion = _filled(0.5 * (former + later)[None])
    window = np.hanning(valid.size) * np.sqrt(8.0 / 3.0)
    strong = np.flatnonzero(2.0 * _CHANGE**2 * _spectrum(window * (motion - motion.mean()))[0] > fast)
    slow = max(int(_SLOW * power.shape[1]), int(strong[-1]) + 1 if strong.size else 1, 1)
    if 4 * slow > _fastest(power) or not valid.any():
        return 0.0, fast
    excess = float(_beyond_fast(power, slow)[0])
    if not valid.all():  # interpolation attenuates fast noise more than slow noise
        like = _spectrum(interpolated_noise(valid))
        excess -= fast * float(np.mean(_beyond_fast(like, slow)) / np.mean(like[:, _fastest(like) :]))
    return excess, fast


def _spectrum(signal: Array) -> Array:
    """Return the power of each line of signals (rows, samples); for white noise, its mean is the variance."""
    power: Array = np.square(np.abs(np.fft.rfft(signal, axis=1))) / signal.shape[1]
    return power


def _fastest(power: Array) -> int:
    """Return the index of the first line in the upper quarter of a spectrum (rows, lines)."""
    lines: int = power.shape[1]
    return 3 * lines // 4


def _beyond_fast(power: Array, slow: int) -> Array:
    """Return the power of signals in excess of white noise, measured in the upper quarter of the lines (rows,).

    power: their spectrum (rows, lines), whose first `slow` lines may contain more than noise.
    """
    fastest = _fastest(power)
    fast, above = power[:, fastest:].mean(axis=1), power[:, slow : 2 * slow].mean(axis=1)
    steeper = np.clip(above / np.maximum(power[:, 2 * slow : 4 * slow].mean(axis=1), 1e-300), 1.0, _OCTAVE)
    below = slow * np.minimum(steeper * above, power[:, 1 : slow + 1].mean(axis=1))
    beyond: Array = (below + power[:, slow:fastest].sum(axis=1) - fastest * fast) / power.shape[1]
    return beyond


def agreed_noise(white: Array, repeated: Array | None, samples: int) -> Array:
    """Return the noise (joints,) [rad] from two upper bounds on it: their mean if they agree, otherwise the smaller
    one.

    Each bound is the median of a few lines and therefore uncertain, so taking the smaller of two that agree would
    underestimate the noise.

    Args:
        white: bound from the highest lines of a period of `samples` samples (joints,) [rad].
        repeated: bound from the difference between two halves of such periods (joints,) [rad], if known.
        samples: number of samples of the period.
    """
    if repeated is None:
        return white
    lines = samples / _LINES
    apart = np.abs(np.log(np.maximum(white, 1e-300) / np.maximum(repeated, 1e-300)))
    agree = apart < AGREE * _LINE_ERROR * np.sqrt(3.0 / lines)
    mean = np.sqrt((2.0 * white**2 + repeated**2) / 3.0)  # the difference has half as many lines
    noise: Array = np.where(agree, mean, np.minimum(white, repeated))
    return noise


def _power(difference: Array) -> Array:
    """Return the power of the white noise (joints,) [steps^2]."""
    power: Array = np.square(white_noise(_filled(difference), np.isfinite(difference)))
    return power


def _not_drifted(difference: Array, differs: Array) -> Array:
    """Return the fraction (joints, orders) of each order of the rounding error that repeats despite drift.

    difference: difference of two passes (joints, samples) [steps]. differs: as in `_repeating` (joints,). The estimated
    drift contains noise, whose power is a fraction of `differs`; the effect of this noise is divided out.
    """
    filled = _filled(difference)
    closed = without_jump(filled)
    drift = filled - closed + slow_part(closed, max(1, int(_SLOW * filled.shape[1] / 2)))
    alike = np.cos(2.0 * np.pi * _ORDERS[:, None] * drift[:, None, :]).mean(axis=2)
    noise = (2.0 * np.pi * _ORDERS) ** 2 * _SLOW * differs[:, None]
    kept: Array = np.where(noise < _MOST_NOISE, np.clip(alike * np.exp(np.minimum(noise, _MOST_NOISE)), -1.0, 1.0), 0.0)
    return kept


def _repeating(differs: float, kept: Array) -> float:
    """Return the power of the repeating part of the rounding error [steps^2].

    differs: half the mean square of the difference [steps^2]. kept: fraction of each order that drift leaves (orders,).
    """
    repeats = _REPEATS @ kept
    return float(np.interp(differs, np.maximum.accumulate(_STD**2 + ROUNDING - repeats), repeats))


def _filled(difference: Array) -> Array:
    """Replace missing samples by interpolation between their neighbours; by zero if all are missing."""
    index = np.arange(difference.shape[1])
    filled = np.zeros_like(difference)
    for row, known in zip(filled, difference, strict=True):
        valid = np.isfinite(known)
        if valid.any():
            row[:] = np.interp(index, index[valid], known[valid])
    return filled
