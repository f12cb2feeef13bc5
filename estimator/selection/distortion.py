"""Noise, nonlinear distortion and model error, separated by the lines on which they appear.

Pintelon and Schoukens, System Identification, 2nd ed. (2012), chapter 4. Driven on odd lines only, an arm answers on
them and, as far as it is nonlinear, on others: what turns its sign with the motion (friction, gravity about a hanging
pose) makes odd lines, what does not (an offset, friction that differs with direction, a pose aside) even ones. A driven
odd line is left out here and there to see the former: a detection line. With even lines driven too, odd distortion
lands everywhere, and lines that were not driven cannot be told odd from even: they are then all of one group. The
residual of a fit on each group beyond the noise is its model error there.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array, Mask
from hil.estimator.data.fourier import Lines, cut_off, lines_of, noise_power
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate

EXCITED = 1e-4  # of the strongest line's power; a command's rounding leaves 1e-7


@dataclass(frozen=True)
class LineGroup:
    """Lines of one kind."""

    lines: int
    """How many."""
    motion: Array
    """RMS motion on one of them (joints,) [encoder steps]."""
    left: Array
    """The same of what the fit leaves of it."""


@dataclass(frozen=True)
class Distortion:
    """RMS of one line, group by group, in encoder steps (joints,)."""

    noise: Array
    """Of a line, from the scatter between periods or the upper half of the lines, whichever is more."""
    excited: LineGroup
    """Lines that some joint was driven with."""
    odd: LineGroup | None
    """Odd lines up to the highest driven one that none was driven with; None unless all driven ones are odd."""
    even: LineGroup | None
    """Even ones likewise."""
    other: LineGroup | None
    """All the others up to where motion meets noise."""


def excited_lines(period: SettledPeriod) -> Mask:
    """Which harmonics, from 0, some joint was driven with (lines,)."""
    drive = period.torque if period.stabiliser is None else period.stabiliser.excitation
    power = np.abs(lines_of(drive)) ** 2
    power[:, 0] = 0.0
    excited: Mask = (power > EXCITED * power.max(axis=1, keepdims=True)).any(axis=0)
    return excited


def distortion(period: SettledPeriod, estimate: Estimate) -> Distortion:
    """The levels of one period, and of the residual of `estimate`."""
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
    assert driven is not None  # torque that is nowhere on a line is refused before
    scatter = np.zeros(period.joints) if period.position_std is None else period.position_std
    noise = np.sqrt(2.0 * np.maximum(noise_power(lines), scatter**2 / period.samples)) / step
    return Distortion(
        noise, driven, group(detecting & (order % 2 == 1)), group(detecting & (order % 2 == 0)), group(other)
    )


def _rms(lines: Lines, chosen: npt.NDArray[np.bool_]) -> Array:
    rms: Array = np.sqrt(2.0 * np.mean(np.abs(lines[:, chosen]) ** 2, axis=1))
    return rms
