"""Noise, nonlinear distortion and model error, separated by the spectral lines on which they appear.

The method is that of Pintelon and Schoukens, System Identification, 2nd ed. (2012), chapter 4. Line k is the
component of a signal with k cycles per period. An arm that is excited only on odd lines responds on these lines and,
since it is nonlinear, on others as well. Effects that change sign with the motion (friction, gravity about a hanging
pose) appear on odd lines; others (an offset, direction-dependent friction, gravity about any other pose) appear on even
lines. Some odd lines, the detection lines, are left unexcited. If even lines are excited too, odd distortion appears on
all lines, so the unexcited lines cannot be separated into odd and even and form a single group. On each group of lines,
the part of a fit's residual that exceeds the noise is the model error.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array, Mask
from hil.estimator.data.fourier import Lines, cut_off, lines_of, noise_power
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate

EXCITED = 1e-4  # fraction of the strongest line's power; the rounding of a command leaves 1e-7


@dataclass(frozen=True)
class LineGroup:
    """A group of spectral lines, such as all excited lines or all even lines."""

    lines: int
    """Number of lines."""
    motion: Array
    """RMS of the motion per line (joints,) [encoder steps]."""
    left: Array
    """RMS of the fit's residual per line (joints,) [encoder steps]."""


@dataclass(frozen=True)
class Distortion:
    """RMS per line (joints,) [encoder steps] for each group of spectral lines."""

    noise: Array
    """Noise per line: the larger of two estimates, from the scatter between periods and from the highest lines."""
    excited: LineGroup
    """The spectral lines on which at least one joint was excited."""
    odd: LineGroup | None
    """Unexcited odd lines up to the highest excited one; None unless all excited lines are odd."""
    even: LineGroup | None
    """Unexcited even lines up to the highest excited one; None unless all excited lines are odd."""
    other: LineGroup | None
    """All other lines with motion above the noise."""


def excited_lines(period: SettledPeriod) -> Mask:
    """Return, for each Fourier line from line 0 on, whether any joint was excited on it (lines,)."""
    drive = period.torque if period.stabiliser is None else period.stabiliser.excitation
    power = np.abs(lines_of(drive)) ** 2
    power[:, 0] = 0.0
    excited: Mask = (power > EXCITED * power.max(axis=1, keepdims=True)).any(axis=0)
    return excited


def distortion(period: SettledPeriod, estimate: Estimate) -> Distortion:
    """Return the levels of motion, noise and residual of `estimate` in one period."""
    lines = lines_of(period.filled())
    left = lines_of(np.nan_to_num(estimate.residual))
    order = np.arange(lines.shape[1])
    excited = excited_lines(period)
    silent = ~excited & (order > 0)
    highest = int(order[excited].max())
    told_apart = not np.any(excited & (order % 2 == 0))
    detecting = silent & (order <= highest) & told_apart
    other = silent & ~detecting & (order <= max(cut_off(lines), highest))
    step = period.position_step

    def group(chosen: Mask) -> LineGroup | None:
        count = int(chosen.sum())
        return LineGroup(count, _rms(lines, chosen) / step, _rms(left, chosen) / step) if count else None

    driven = group(excited)
    assert driven is not None  # a torque with no lines was rejected earlier
    scatter = np.zeros(period.joints) if period.position_std is None else period.position_std
    # At low rates the motion reaches into the upper half of the lines.
    white = np.minimum(noise_power(lines), np.square(period.noise) / period.samples)
    noise = np.sqrt(2.0 * np.maximum(white, scatter**2 / period.samples)) / step
    return Distortion(
        noise, driven, group(detecting & (order % 2 == 1)), group(detecting & (order % 2 == 0)), group(other)
    )


def _rms(lines: Lines, chosen: Mask) -> Array:
    rms: Array = np.sqrt(2.0 * np.mean(np.abs(lines[:, chosen]) ** 2, axis=1))
    return rms
