"""Estimate the lag and scale error of a servo's velocity relative to its position, and detect a lag that changes.

The lag is the slope of the difference `apart` (see `hil.experiment.checks.consistency`) over the velocity minus its
mean in the short memory; a scale error is the slope over the distance covered. Both are estimated by least squares,
together with a constant.

Neither error changes during a run. The lag in the last `BLOCKS` blocks of `BLOCK_S` is therefore compared with that in
all earlier blocks, with a tolerance for their uncertainties and for a filter, whose lag depends on the frequency of the
motion.
"""

from typing import Any

import numpy as np

from hil.estimator.compiled import embedded, inner

BLOCK_S, BLOCKS = 0.1, 4
"""Duration of a block [s], and the number of blocks that are compared with all earlier ones."""

CHANGED_S, CHANGED_SHARE = 0.005, 0.35
"""Accepted change of the lag: an absolute part [s], and a fraction of the earlier lag."""

TIMES = 4.0
NOISE_RAD, LASTS_S = 0.0015, 0.1
"""Lower bound on the standard deviation of `apart` [rad], and correlation time of its errors [s]."""

LEAST_INFORMATION = 0.1
"""Smallest integral of the squared change of velocity, excluding the part that a scale error explains, at which lags
are compared [rad^2/s].
"""

ENOUGH_INFORMATION, ALL_INFORMATION = 0.3, 3.0
"""Integrals as in `LEAST_INFORMATION`, but over the whole run: above the first, lag and scale error count as known;
above the second, they are no longer updated.
"""

SEPARATE = 0.05
"""Fraction of the squared change of velocity that a scale error must leave unexplained to be distinct from a lag."""

LONGEST_S = 0.015
"""Longest interval between two samples during which the velocity is known well enough [s]."""

_SUMS = 10
_LAG_2, _FAR_2, _CROSSED, _LAG_APART, _FAR_APART, _APART_2, _SECONDS, _LAG, _FAR, _APART = range(_SUMS)

LAGS = np.dtype(
    [
        *(("block", "f8", (_SUMS,)), ("recent", "f8", (BLOCKS, _SUMS)), ("before", "f8", (_SUMS,)), ("oldest", "i8")),
        *((name, "f8") for name in ("information", "lag", "lag_std", "scale", "scale_std", "noise")),
    ]
)
"""Sums of products over the current block, the latest complete blocks, and all earlier blocks. oldest: row of the
oldest complete block. information: information about the lag [rad^2/s]. The remaining fields are lag and scale error
with their standard deviations [s, 1], and the RMS residual [rad]; all are 0 while the information is less than
`ENOUGH_INFORMATION`.
"""


def add(lags: Any, change: float, far: float, apart: float, seconds: float) -> bool:
    """Process a sample, `seconds` after the previous one; return whether the lag has changed.

    change: velocity minus its mean [rad/s]. far, apart: distance covered, and its difference from the integral of the
    velocity [rad].
    """
    if seconds > LONGEST_S:
        return False
    block = lags.block
    block[_LAG_2] += seconds * change * change
    block[_FAR_2] += seconds * far * far
    block[_CROSSED] += seconds * change * far
    block[_LAG_APART] += seconds * change * apart
    block[_FAR_APART] += seconds * far * apart
    block[_APART_2] += seconds * apart * apart
    block[_SECONDS] += seconds
    block[_LAG] += seconds * change
    block[_FAR] += seconds * far
    block[_APART] += seconds * apart
    return bool(block[_SECONDS] >= BLOCK_S and _completes_block(lags))


def forget(lags: Any) -> None:
    """Discard the current block: nothing is known about the motion since the previous sample."""
    for each in range(_SUMS):
        lags.block[each] = 0.0


def _completes_block(lags: Any) -> bool:
    row, latest, every = lags.recent[lags.oldest], np.zeros(_SUMS), np.zeros(_SUMS)
    for each in range(_SUMS):
        lags.before[each] += row[each]
        row[each] = lags.block[each]
        lags.block[each] = 0.0
        for number in range(BLOCKS):
            latest[each] += lags.recent[number, each]
        every[each] = lags.before[each] + latest[each]
    lags.oldest = (lags.oldest + 1) % BLOCKS
    if lags.information < ALL_INFORMATION:
        lag, scale, information, variance, per_scale = _fitted(every)
        if information >= ENOUGH_INFORMATION:
            lags.lag, lags.scale, lags.information, lags.noise = lag, scale, information, np.sqrt(variance)
            lags.lag_std = np.sqrt(variance * LASTS_S / information)
            lags.scale_std = np.sqrt(variance * LASTS_S / per_scale)
    lag, _, information, variance, _ = _fitted(latest)
    former, _, informed, usual, _ = _fitted(lags.before)
    if min(information, informed) < LEAST_INFORMATION:
        return False
    uncertain = np.sqrt(max(variance, usual) * LASTS_S * (1.0 / information + 1.0 / informed))
    return bool(abs(lag - former) > CHANGED_S + CHANGED_SHARE * abs(former) + TIMES * uncertain)


def _fitted(sums: Any) -> tuple[float, float, float, float, float]:
    """Return lag [s], scale error, information about the lag [rad^2/s], residual variance [rad^2], and information
    about the scale error [rad^2 s]; all 0 if the two errors cannot be distinguished.
    """
    seconds = max(sums[_SECONDS], 1e-9)
    lag_2 = sums[_LAG_2] - sums[_LAG] * sums[_LAG] / seconds
    far_2 = sums[_FAR_2] - sums[_FAR] * sums[_FAR] / seconds
    crossed = sums[_CROSSED] - sums[_LAG] * sums[_FAR] / seconds
    determinant = lag_2 * far_2 - crossed * crossed
    if determinant <= SEPARATE * lag_2 * far_2:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    by_lag = sums[_LAG_APART] - sums[_LAG] * sums[_APART] / seconds
    by_far = sums[_FAR_APART] - sums[_FAR] * sums[_APART] / seconds
    lag = (by_lag * far_2 - by_far * crossed) / determinant
    scale = (by_far * lag_2 - by_lag * crossed) / determinant
    left = sums[_APART_2] - sums[_APART] * sums[_APART] / seconds - lag * by_lag - scale * by_far
    return lag, scale, determinant / far_2, max(left / seconds, NOISE_RAD * NOISE_RAD), determinant / lag_2


_fitted = embedded(_fitted)
_completes_block = embedded(_completes_block)
add, forget = map(inner, (add, forget))
